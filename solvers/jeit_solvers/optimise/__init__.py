"""Minimisation: descent along quadratic models, many small problems at once, and problems between bounds."""
