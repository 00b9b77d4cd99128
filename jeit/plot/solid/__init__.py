"""Plots of bodies in space: surfaces, solids, and slices through solids."""
