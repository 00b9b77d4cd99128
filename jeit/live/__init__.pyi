from .pictures import AbstractView, LiveFrame, Marker, Picture, Scene
from .views.conductivity import ConductivityView

__all__ = ["AbstractView", "ConductivityView", "LiveFrame", "Marker", "Picture", "Scene"]
