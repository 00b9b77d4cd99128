"""Passive acoustic tomography: locate touches on a skin from the signals of an array of microphones under it.

`read_taps` reads calibration taps, and `calibrate_microphones` fits a decay model of every microphone to them.
`read_recording` reads a recording, and `locate_touches` computes the positions and tracks of its touches; its steps are
`intensities`, `locate` and `track`. The underlying estimator is `Localiser`, which is batched and differentiable.
`cramer_rao` computes the Cramér-Rao bound.

Recordings are simulated by a `SoundingSkin` and the functions `simulate_…`; results are drawn by `plot_…` and written
to files by `write_…`. What users need of the subpackages is exported here.
"""

from __future__ import annotations

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
