"""Gestures: a stream of images cut into touches, what is measured of each, and which of the learnt gestures it is."""
