"""Sparse symmetric systems: the multifrontal direct solver, conjugate gradients, and the choice between them."""
