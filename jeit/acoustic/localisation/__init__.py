"""From intensities to places: objectives, their minimisation, maps, bounds, and recordings located frame by frame."""
