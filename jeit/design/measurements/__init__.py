"""Measurement selection: candidate measurements, and the choice of the most informative."""
