"""Benchmarks: jeit beside others, time and accuracy in one table. `python -m benchmarks` lists the cases."""
