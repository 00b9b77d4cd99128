"""Numerics with no physics in it."""
