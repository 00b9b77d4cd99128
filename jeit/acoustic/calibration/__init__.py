"""From taps at known places to the decay model and noise of every microphone."""
