"""Frames of a round skin without a mesh: the voltage changes by a small touch between point electrodes on its edge.

In a disk, current that enters at e and leaves at e′ has the field ∇u ∝ (p − e)/|p − e|² − (p − e′)/|p − e′|². A small
change at p changes the voltage of drive d and measurement m by −∇u_d·∇u_m.
"""

import numpy as np

RADIUS = 0.1
# Noise of a channel. Touches in the middle change channels by five times this, touches near the edge by fifty times.
NOISE = 4e-6


def _fields(places):
    """∇u (n, 16, 2) of the sixteen adjacent pairs at places (n, 2)."""
    angle = 2 * np.pi * np.arange(16) / 16
    electrodes = RADIUS * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    off = np.asarray(places)[:, None] - electrodes
    single = off / np.sum(off**2, axis=-1, keepdims=True)
    return single - np.roll(single, -1, axis=1)


_DRIVE, _MEASURE = np.array([(d, (d + k) % 16) for d in range(16) for k in range(2, 15)]).T
CHANNELS = len(_DRIVE)
REST = np.linspace(0.2, 0.4, CHANNELS)


def changes(places):
    """Voltage changes (n, 208) by a touch at each of the places (n, 2), relative to the untouched frame."""
    fields = _fields(places)
    return -3e-6 * np.sum(fields[:, _DRIVE] * fields[:, _MEASURE], axis=-1)


def frames_at(places):
    """Frames (n, 208) of touches at places (n, 2)."""
    return REST + changes(places)


def drawn_places(seed, number, radius=0.085):
    """Draw places (n, 2) uniformly in the disk."""
    random = np.random.default_rng(seed)
    r, angle = radius * np.sqrt(random.uniform(size=number)), random.uniform(0, 2 * np.pi, number)
    return np.stack([r * np.cos(angle), r * np.sin(angle)], axis=1)
