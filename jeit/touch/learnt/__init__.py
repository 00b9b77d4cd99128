"""Skins that learn: from recorded presses to where, how hard and by what a skin is touched, without a model of it."""
