"""Localisation from intensities: objectives, their minimisation, maps, bounds, and localisation frame by frame."""
