"""Passive acoustic tomography: an array of microphones under a skin hears a touch, and says where it is.

`read_taps` and `calibrate_microphones` give the decay model of every microphone, kept in a `Calibration`;
`read_recording` and `locate_touches` turn a recording into places and strokes, step by step through `intensities`,
`locate` and `track`. Beneath them: `Localiser`, which is batched and differentiable, and the Cramér-Rao bound.

Rooms: `signal` (recordings, faults, intensities), `calibration` (fits to taps), `localisation` (objectives, minima,
maps, two sources). Beside them: `decay`, the decay models; `microphones`, the array; `surface`, on which
sources are; `noise`; `track`, places in time; `touches`, all of it in one call.
"""

from jeit.acoustic.calibration.calibrate import calibrate_microphones as calibrate_microphones
from jeit.acoustic.calibration.calibration import Calibration as Calibration
from jeit.acoustic.localisation.cramer_rao import cramer_rao as cramer_rao
from jeit.acoustic.localisation.localiser import Localiser as Localiser
from jeit.acoustic.localisation.locate import locate as locate
from jeit.acoustic.microphones import MicrophoneArray as MicrophoneArray
from jeit.acoustic.signal.intensity import IntensitySettings as IntensitySettings
from jeit.acoustic.signal.intensity import intensities as intensities
from jeit.acoustic.signal.intensity import tap_intensities as tap_intensities
from jeit.acoustic.signal.recording import Intensities as Intensities
from jeit.acoustic.signal.recording import Recording as Recording
from jeit.acoustic.signal.recording import Taps as Taps
from jeit.acoustic.signal.recording import read_recording as read_recording
from jeit.acoustic.signal.recording import read_taps as read_taps
from jeit.acoustic.signal.recording import write_recording as write_recording
from jeit.acoustic.signal.recording import write_taps as write_taps
from jeit.acoustic.touches import LocatedTouches as LocatedTouches
from jeit.acoustic.touches import locate_touches as locate_touches
from jeit.acoustic.tracking import track as track
