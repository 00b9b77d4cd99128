"""Passive acoustic tomography: locate touches on a skin from the signals of an array of microphones under it.

`read_taps` reads calibration taps, and `calibrate_microphones` fits a decay model of every microphone to them.
`read_recording` reads a recording, and `locate_touches` computes the positions and tracks of its touches; its steps are
`intensities`, `locate` and `track`. The underlying estimator is `Localiser`, which is batched and differentiable.
`cramer_rao` computes the Cramér-Rao bound.

Subpackages: `signal` (recordings, faults, intensities), `calibration` (fits to taps), `localisation` (objectives,
their minimisation, maps, two sources), `simulate` (simulated recordings), `plots`. Modules: `decay` (decay models),
`microphones` (the array), `surface` (the surface on which sources lie), `noise` (the error model of intensities),
`tracking` (smoothing over time), `touches` (all steps in one call).
"""

from __future__ import annotations

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
