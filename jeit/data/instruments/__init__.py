"""Readers of what instruments write: a file each, from what is published of its format.

None of these files says where electrodes are: a description beside it (`[geometry]`, `[electrodes]`) does. What is not
published, the scale of the numbers say, is a note of the measurement.
"""
