from .pictures import AbstractView, LiveFrame, Marker, Picture, Scene
from .views import ConductivityView

__all__ = ["AbstractView", "ConductivityView", "LiveFrame", "Marker", "Picture", "Scene"]
