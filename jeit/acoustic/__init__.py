"""Passive acoustic tomography: an array of microphones under a skin hears a touch, and says where it is.

`read_taps` and `calibrate_microphones` give the decay model of every microphone, kept in a `Calibration`;
`read_recording`, `locate` and `track` turn a recording into places and strokes. Beneath them: `Localiser`, which is
batched and differentiable, decay models, intensities, two sources at once, and the Cramér-Rao bound.
"""

from jeit.acoustic.calibration.calibrate import CalibrationFit as CalibrationFit
from jeit.acoustic.calibration.calibrate import calibrate_microphones as calibrate_microphones
from jeit.acoustic.calibration.calibration import Calibration as Calibration
from jeit.acoustic.decay import AbstractDecay as AbstractDecay
from jeit.acoustic.decay import AttenuatedInverseSquare as AttenuatedInverseSquare
from jeit.acoustic.decay import Exponential as Exponential
from jeit.acoustic.decay import InverseSquare as InverseSquare
from jeit.acoustic.localisation.calibrated_intensities import calibrated_intensities as calibrated_intensities
from jeit.acoustic.localisation.cramer_rao import cramer_rao as cramer_rao
from jeit.acoustic.localisation.localiser import Localiser as Localiser
from jeit.acoustic.localisation.localiser import SourceEstimate as SourceEstimate
from jeit.acoustic.localisation.locate import Locations as Locations
from jeit.acoustic.localisation.locate import locate as locate
from jeit.acoustic.localisation.locate import microphones_in_use as microphones_in_use
from jeit.acoustic.localisation.overlay import brightness as brightness
from jeit.acoustic.localisation.overlay import fade as fade
from jeit.acoustic.localisation.overlay import overlay as overlay
from jeit.acoustic.localisation.setup_changes import SetupChanges as SetupChanges
from jeit.acoustic.localisation.setup_changes import find_setup_changes as find_setup_changes
from jeit.acoustic.localisation.two_sources import TwoSources as TwoSources
from jeit.acoustic.localisation.two_sources import locate_two as locate_two
from jeit.acoustic.microphones import MicrophoneArray as MicrophoneArray
from jeit.acoustic.noise import IntensityNoise as IntensityNoise
from jeit.acoustic.signal.intensity import IntensitySettings as IntensitySettings
from jeit.acoustic.signal.intensity import intensities as intensities
from jeit.acoustic.signal.intensity import noise_floor as noise_floor
from jeit.acoustic.signal.intensity import tap_intensities as tap_intensities
from jeit.acoustic.signal.recording import Intensities as Intensities
from jeit.acoustic.signal.recording import Recording as Recording
from jeit.acoustic.signal.recording import Taps as Taps
from jeit.acoustic.signal.recording import read_recording as read_recording
from jeit.acoustic.signal.recording import read_taps as read_taps
from jeit.acoustic.signal.recording import write_recording as write_recording
from jeit.acoustic.signal.recording import write_taps as write_taps
from jeit.acoustic.surface import make_surface as make_surface
from jeit.acoustic.track import Touch as Touch
from jeit.acoustic.track import Track as Track
from jeit.acoustic.track import track as track
