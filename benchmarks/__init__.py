"""Benchmarks: jeit compared with other libraries, with time and accuracy in one table. `python -m benchmarks` lists the
cases."""
