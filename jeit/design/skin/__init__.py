"""Skins and touches: indentations, the cells that they change, and the resulting voltage changes."""
