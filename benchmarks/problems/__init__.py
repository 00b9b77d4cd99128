"""The problems of the contestants, as plain arrays, and references for their results."""
