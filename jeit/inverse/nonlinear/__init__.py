"""Nonlinear least squares for conductivity itself: the problem, its scales and unknowns, and what solves it."""
