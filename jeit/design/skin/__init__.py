"""Skins and touches: indentations, the cells they change, and the resulting voltage changes."""
