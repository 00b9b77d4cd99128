"""The problems that the contestants solve, as plain arrays, and reference solutions."""
