"""What is not measured: skins that are pressed, skins that sound, and the touches on them."""

from jeit.simulate.round_skin import RoundSkin as RoundSkin
from jeit.simulate.round_skin import pressed_conductivity as pressed_conductivity
from jeit.simulate.round_skin import simulate_press as simulate_press
from jeit.simulate.sounding_skin import SoundingSkin as SoundingSkin
from jeit.simulate.sounding_skin import microphone_grid as microphone_grid
from jeit.simulate.touch_sounds import CalibrationTaps as CalibrationTaps
from jeit.simulate.touch_sounds import SimulatedSound as SimulatedSound
from jeit.simulate.touch_sounds import calibration_taps as calibration_taps
from jeit.simulate.touch_sounds import pat as pat
from jeit.simulate.touch_sounds import quiet as quiet
from jeit.simulate.touch_sounds import stroke as stroke
from jeit.simulate.touch_sounds import superpose as superpose
from jeit.simulate.touch_sounds import tap as tap
from jeit.simulate.touch_sounds import tickle as tickle
