from .gesture_stream import GestureStream, simulate_gesture_stream
from .manners import GESTURES, MANNERS, TRAITS, Manner
from .person import Person
from .simulated_gestures import simulate_gestures

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
