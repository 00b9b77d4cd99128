"""People who touch a skin: how each of them makes each of six gestures, and what the skin reads."""

from __future__ import annotations

from jeit.simulate.people.gesture_stream import GestureStream, simulate_gesture_stream
from jeit.simulate.people.manners import GESTURES, MANNERS, TRAITS, Manner
from jeit.simulate.people.person import Person
from jeit.simulate.people.simulated_gestures import simulate_gestures

__all__ = [
    "GESTURES",
    "MANNERS",
    "TRAITS",
    "GestureStream",
    "Manner",
    "Person",
    "simulate_gesture_stream",
    "simulate_gestures",
]
