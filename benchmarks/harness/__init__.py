"""Measurement: contestants in separate processes, their turns, their memory, the machine, and tables of results."""
