"""Simulated skins and touches, where nothing is measured: skins that are pressed, skins that sound, and the
touches on them.

What a sounding skin is made of (its layer, microphones and readout) is in `jeit.simulate.acoustic`.
"""

from jeit.simulate.acoustic.bursts import Burst as Burst
from jeit.simulate.acoustic.calibration_taps import calibration_taps as calibration_taps
from jeit.simulate.acoustic.microphones import microphone_grid as microphone_grid
from jeit.simulate.acoustic.sound import quiet as quiet
from jeit.simulate.acoustic.sounding_skin import SoundingSkin as SoundingSkin
from jeit.simulate.acoustic.touches import pat as pat
from jeit.simulate.acoustic.touches import stroke as stroke
from jeit.simulate.acoustic.touches import tap as tap
from jeit.simulate.acoustic.touches import tickle as tickle
from jeit.simulate.round_skin import RoundSkin as RoundSkin
from jeit.simulate.round_skin import simulate_press as simulate_press
