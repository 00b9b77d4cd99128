"""Plots of bodies and images: meshes, electrodes, conductivity, inclusions, voltages, and choices of λ."""
