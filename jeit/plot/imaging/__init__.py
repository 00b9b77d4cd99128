"""Pictures of bodies and images: meshes, electrodes, conductivity, inclusions, voltages, choices of λ."""
