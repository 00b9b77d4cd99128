"""Benchmarks: jeit beside pyEIT and plain SciPy, time and accuracy in one table. Run `python -m benchmarks`."""
