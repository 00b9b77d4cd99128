"""Priors of images: quadratic priors, total variation, and their bases."""
