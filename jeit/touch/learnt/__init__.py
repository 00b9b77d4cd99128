"""Estimate where, how hard and by what a skin is touched, by models learnt from recorded presses, without a physical
model."""
