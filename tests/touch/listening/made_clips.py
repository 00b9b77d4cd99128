"""Clips of taps on three synthetic materials: decaying tones with a pitch and decay of their own."""

import numpy as np

from jeit.acoustic import Recording

MATERIALS = {"wood": (300.0, 0.02), "metal": (900.0, 0.2), "glass": (1800.0, 0.08)}


def struck(random: np.random.Generator, material: str, rate: float = 44_100.0, seconds: float = 0.25) -> Recording:
    """One tap, louder or softer, on a larger or smaller object, with a little noise."""
    pitch, decay = MATERIALS[material]
    times = np.arange(round(seconds * rate)) / rate
    sound = np.zeros(len(times))
    for overtone in (1, 2.7, 5.1):
        own = pitch * overtone * (1 + 0.03 * random.standard_normal())
        fades = decay * (1 + 0.1 * random.standard_normal()) / np.sqrt(overtone)
        sound += np.sin(2 * np.pi * own * times + random.uniform(0, 6)) * np.exp(-times / fades)
    samples = 0.05 * 10 ** (0.1 * random.standard_normal()) * sound + 1e-4 * random.standard_normal(len(times))
    return Recording(samples[None], rate, name=material)
