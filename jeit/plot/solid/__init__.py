"""Pictures of bodies in space: surfaces, solids, and slices through them."""
