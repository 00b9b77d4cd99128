"""Recordings of microphones and their files, detection of faulty microphones, and sound intensities computed from
samples."""
