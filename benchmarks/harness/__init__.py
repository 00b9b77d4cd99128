"""Measurement: contestants in processes of their own, their turns, their memory, the machine, and tables."""
