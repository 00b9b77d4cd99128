from .pictures import AbstractView, LiveFrame, Marker, Picture, Scene
from .preparation import Prepared, prepare
from .recording import Recorder
from .server import serve
from .session import Result, Session, frames
from .simulated import SimulatedSensor, simulated_skin, simulated_tank
from .sources import AbstractSource, open_source
from .views.conductivity import ConductivityView
from .views.contacts import ContactsView, GestureView
from .views.learnt import DepthView, LearntSkinView
from .views.sound import SoundView

__all__ = [
    "AbstractSource",
    "AbstractView",
    "ConductivityView",
    "ContactsView",
    "DepthView",
    "GestureView",
    "LearntSkinView",
    "LiveFrame",
    "Marker",
    "Picture",
    "Prepared",
    "Recorder",
    "Result",
    "Scene",
    "Session",
    "SimulatedSensor",
    "SoundView",
    "frames",
    "open_source",
    "prepare",
    "serve",
    "simulated_skin",
    "simulated_tank",
]
