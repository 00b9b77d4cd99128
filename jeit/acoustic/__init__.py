"""Passive acoustic tomography: locate touches on a skin from the signals of an array of microphones under it.

`read_taps` and `calibrate_microphones` fit the decay model of every microphone and return a `Calibration`.
`read_recording` and `locate_touches` convert a recording to positions and tracks; `intensities`, `locate` and `track`
are the steps. The underlying estimator is `Localiser`, which is batched and differentiable; `cramer_rao` computes the
Cramér-Rao bound.

Subpackages: `signal` (recordings, faults, intensities), `calibration` (fits to taps), `localisation` (objectives,
minima, maps, two sources). Modules: `decay`, the decay models; `microphones`, the array; `surface`, the surface on
which sources lie; `noise`; `tracking`, positions over time; `touches`, the whole pipeline in one call.
"""

from __future__ import annotations

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
