"""Intensities from samples: recordings and their files, band power, faults of microphones."""
