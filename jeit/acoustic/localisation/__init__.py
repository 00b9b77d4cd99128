"""Localisation of sound sources from intensities: objectives, their minimisation, maps of the objectives, and the
Cramér-Rao bound."""
