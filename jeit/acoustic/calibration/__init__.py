"""Calibration: estimation of the decay model and the noise of each microphone from taps at known positions."""
