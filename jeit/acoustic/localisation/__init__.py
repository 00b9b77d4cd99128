"""Localisation of sound sources from intensities: objectives, their minimisation, maps, and the Cramér-Rao bound."""
