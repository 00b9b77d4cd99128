"""The 2-D generator: outlines walked by arc length, triangulated, smoothed and repaired (NumPy and SciPy)."""
