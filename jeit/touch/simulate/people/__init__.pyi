from .person import GESTURES, MANNERS, TRAITS, Manner, Person
from .simulated_gestures import GestureStream, simulate_gesture_stream, simulate_gestures

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
