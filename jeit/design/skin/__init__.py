"""Skins and touches: indentations, the mesh cells that indentations change, and the resulting voltage changes."""
