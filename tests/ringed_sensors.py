"""Frames of a round skin that need no mesh: what a small touch changes between point electrodes on its edge.

In a disk, current that enters at e and leaves at e′ has the field ∇u ∝ (p − e)/|p − e|² − (p − e′)/|p − e′|²; a small
change at p changes the voltage of drive d and measurement m by −∇u_d·∇u_m.
"""

import numpy as np

RADIUS = 0.1
# Of a channel: touches in the middle change channels by five times that, touches near the edge by fifty.
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
    """What a touch at each of places (n, 2) adds to the untouched frame (n, 208)."""
    fields = _fields(places)
    return -3e-6 * np.sum(fields[:, _DRIVE] * fields[:, _MEASURE], axis=-1)


def frames_at(places):
    """Frames (n, 208) of touches at places (n, 2)."""
    return REST + changes(places)


def drawn_places(seed, number, radius=0.085):
    """Places (n, 2) all over the disk."""
    random = np.random.default_rng(seed)
    r, angle = radius * np.sqrt(random.uniform(size=number)), random.uniform(0, 2 * np.pi, number)
    return np.stack([r * np.cos(angle), r * np.sin(angle)], axis=1)
