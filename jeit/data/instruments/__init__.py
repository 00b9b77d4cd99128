"""Readers of instruments' files, one module for each format, from what is published of it.

None of these files says where electrodes are: a description beside it (`[geometry]`, `[electrodes]`) does. What is not
published, such as the scale of the numbers, is stated in a note of the measurement.
"""
