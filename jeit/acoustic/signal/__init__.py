"""From samples to intensities: recordings and their files, power in a band, faults of microphones."""
