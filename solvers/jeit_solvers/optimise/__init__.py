"""Minimisation: descent along quadratic models, many small problems at once, and problems with bounds."""
