"""Generator of plane meshes: outlines parametrised by arc length, triangulation, smoothing and repair."""
