"""Readers of measured data, one module for each file format: published data sets, instruments, and plain tables.

Files of instruments do not say where electrodes are: a description beside them (`[geometry]`, `[electrodes]`) does.
What is not published of them, such as the scale of the numbers, is stated in a note of the measurement.
"""
