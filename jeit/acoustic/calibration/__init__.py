"""Calibration: the decay model and noise of every microphone, estimated from taps at known positions."""
