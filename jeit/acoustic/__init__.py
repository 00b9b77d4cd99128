"""Passive acoustic tomography: an array of microphones under a skin hears a touch, and says where it is.

`read_taps` and `calibrate_microphones` give the decay model of every microphone, kept in a `Calibration`;
`read_recording`, `locate` and `track` turn a recording into places and strokes. Beneath them: `Localiser`, which is
batched and differentiable, decay models, intensities, two sources at once, and the Cramér-Rao bound.
"""

from jeit.acoustic.bound import cramer_rao as cramer_rao
from jeit.acoustic.calibrate import CalibrationFit as CalibrationFit
from jeit.acoustic.calibrate import calibrate_microphones as calibrate_microphones
from jeit.acoustic.calibration import Calibration as Calibration
from jeit.acoustic.changes import Changes as Changes
from jeit.acoustic.changes import find_changes as find_changes
from jeit.acoustic.decay import AbstractDecay as AbstractDecay
from jeit.acoustic.decay import AttenuatedInverseSquare as AttenuatedInverseSquare
from jeit.acoustic.decay import Exponential as Exponential
from jeit.acoustic.decay import InverseSquare as InverseSquare
from jeit.acoustic.intensity import IntensitySettings as IntensitySettings
from jeit.acoustic.intensity import intensities as intensities
from jeit.acoustic.intensity import noise_floor as noise_floor
from jeit.acoustic.intensity import tap_intensities as tap_intensities
from jeit.acoustic.likelihood import Listeners as Listeners
from jeit.acoustic.localiser import Estimate as Estimate
from jeit.acoustic.localiser import Localiser as Localiser
from jeit.acoustic.locate import Locations as Locations
from jeit.acoustic.locate import locate as locate
from jeit.acoustic.locate import prepare as prepare
from jeit.acoustic.measure import measure as measure
from jeit.acoustic.noise import IntensityNoise as IntensityNoise
from jeit.acoustic.overlay import brightness as brightness
from jeit.acoustic.overlay import faded as faded
from jeit.acoustic.overlay import overlay as overlay
from jeit.acoustic.recording import Intensities as Intensities
from jeit.acoustic.recording import Recording as Recording
from jeit.acoustic.recording import Taps as Taps
from jeit.acoustic.recording import read_recording as read_recording
from jeit.acoustic.recording import read_taps as read_taps
from jeit.acoustic.recording import write_recording as write_recording
from jeit.acoustic.recording import write_taps as write_taps
from jeit.acoustic.surface import make_surface as make_surface
from jeit.acoustic.track import Touch as Touch
from jeit.acoustic.track import Track as Track
from jeit.acoustic.track import track as track
from jeit.acoustic.two_sources import TwoSources as TwoSources
from jeit.acoustic.two_sources import locate_two as locate_two
