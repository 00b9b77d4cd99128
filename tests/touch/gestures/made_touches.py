"""Synthetic touches for learning, without a mesh: four kinds of time courses, from people who differ."""

import numpy as np

from jeit.touch.gestures import ChangeCourse, StreamTouch

KINDS = ("tap", "push", "stroke", "slap")


def touch(kind, rng, person=0, scale=1.0):
    """One touch: short or long, weak or strong, still or moving, with log-normal spreads, also between people."""
    own = np.exp(0.25 * np.random.default_rng(1000 + person).normal(size=3) + 0.15 * rng.normal(size=3))
    force, duration, path = (
        own
        * {
            "tap": (1.0, 0.1, 0.002),
            "push": (4.0, 1.0, 0.004),
            "stroke": (2.0, 1.0, 0.1),
            "slap": (4.0, 0.12, 0.003),
        }[kind]
    )
    frames = max(int(60 * duration), 3)
    seconds = np.arange(frames) / 60
    peak = scale * force * (0.2 + np.sin(np.pi * (np.arange(frames) + 0.5) / frames))
    centroid = np.linspace((0, 0), (path, 0), frames) + 1e-4 * rng.normal(size=(frames, 2))
    whole = np.ones(frames)
    return StreamTouch(ChangeCourse(seconds, peak, -0.1 * peak, 0.02 * whole, 0.5 * peak, 1e-3 * whole, centroid))


def touches(people=4, each=5, seed=0, kinds=KINDS):
    """Touches, their kinds, and the person of each."""
    rng = np.random.default_rng(seed)
    rows = [(person, kind) for person in range(people) for kind in kinds for _ in range(each)]
    made = [touch(kind, rng, person) for person, kind in rows]
    return made, np.array([kind for _, kind in rows]), np.array([person for person, _ in rows])
