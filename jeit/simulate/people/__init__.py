"""People who touch a skin: how each of them makes each of six gestures, and what the skin reads."""

from jeit.simulate.people.gesture_set import GestureSet, simulate_gestures
from jeit.simulate.people.manners import GESTURES, MANNERS, TRAITS, Manner
from jeit.simulate.people.person import Person

__all__ = ["GESTURES", "MANNERS", "TRAITS", "GestureSet", "Manner", "Person", "simulate_gestures"]
