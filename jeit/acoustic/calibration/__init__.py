"""Calibration: estimation of the decay model and noise of each microphone from taps at known positions."""
