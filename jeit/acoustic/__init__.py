"""Passive acoustic tomography: an array of microphones under a skin hears a touch, and says where it is.

`read_taps` and `calibrate_microphones` give the decay model of every microphone, kept in a `Calibration`;
`read_recording` and `locate_touches` turn a recording into places and strokes, step by step through `intensities`,
`locate` and `track`. Beneath them: `Localiser`, which is batched and differentiable, and the Cramér-Rao bound.

Rooms: `signal` (recordings, faults, intensities), `calibration` (fits to taps), `localisation` (objectives, minima,
maps, two sources). Beside them: `decay`, the decay models; `microphones`, the array; `surface`, on which
sources are; `noise`; `track`, places in time; `touches`, all of it in one call.
"""

from __future__ import annotations

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
