"""Synthetic presses for learnt skins: voltages that depend nonlinearly on place and force, with drift and noise."""

import numpy as np

CHANNELS = 40


def record(number=160, *, seed=0, noise=0.01, drift=0.0, untouched=0, places=None):
    """Return frames, references, places (m) and forces (N) of presses on a square of 0.1 m; the last are
    `untouched`."""
    rng = np.random.default_rng(seed)
    skin = np.random.default_rng(99)  # the same skin for every set of presses
    centres, depth = skin.uniform(-0.06, 0.06, (CHANNELS, 2)), skin.uniform(0.5, 2.0, CHANNELS)
    random, force = rng.uniform(-0.05, 0.05, (number, 2)), rng.uniform(0.5, 4.0, number)
    places = random if places is None else np.array(places)
    apart = np.linalg.norm(places[:, None] - centres, axis=2)
    touched = np.arange(number) < number - untouched
    size = np.where(touched, force / (force + 2), 0.0)
    reference = depth * (1 + drift * np.linspace(0, 1, number)[:, None])
    frames = reference * (1 + size[:, None] * 0.3 * np.exp(-((apart / 0.04) ** 2)))
    frames = frames + noise * 0.1 * rng.normal(size=frames.shape)
    places[~touched], force[~touched] = np.nan, 0.0
    return {"frames": frames, "reference": reference, "positions": places, "force": force}


def off(touches, places):
    """Localisation error in metres."""
    return np.linalg.norm(touches.position - places, axis=1)
