"""Pictures of what is not plane: surfaces in space, solids, slices through them."""
