"""Readers of measured data, a module or a class for each file format: published data sets, instruments, and plain
tables.

Files of instruments do not state the positions of the electrodes; a description beside the files (`[geometry]`,
`[electrodes]`) states them. The notes of a measurement state assumptions on properties of a format that are not
published, such as the scale of the voltages.
"""
