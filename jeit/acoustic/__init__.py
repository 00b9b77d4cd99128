"""Passive acoustic tomography: locate touches on a skin from the signals of an array of microphones under it.

`read_taps` reads calibration taps, and `calibrate_microphones` fits a decay model of every microphone to the taps.
`read_recording` reads a recording, and `locate_touches` computes the positions and tracks of its touches, in the steps
`intensities`, `locate` and `track`. `Localiser` is the estimator of positions, which is batched and differentiable.
`cramer_rao` computes the Cramér-Rao bound of the positions.

Recordings are simulated by a `SoundingSkin` and the functions `simulate_…`; results are drawn by `plot_…` and written
to files by `write_…`. This package exports the classes and functions that users need.
"""

from __future__ import annotations

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
