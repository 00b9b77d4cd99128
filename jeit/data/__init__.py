"""Measured data: readers, checks of what was measured, and writing it out again.

`read(path)` gives a `Measurement`: voltages, mask, protocol, electrodes, outline. `check_imageable` says
whether a frame can be imaged against a reference.
"""

from jeit.data.description import load_description as load_description
from jeit.data.export import write_table as write_table
from jeit.data.imageable import check_imageable as check_imageable
from jeit.data.measurement import Measurement as Measurement
from jeit.data.quality import estimate_noise as estimate_noise
from jeit.data.quality import impossible_signs as impossible_signs
from jeit.data.quality import reciprocity_error as reciprocity_error
from jeit.data.registry import read as read
from jeit.data.screening import screen as screen
