"""All attributes of a simulated film, which are worse where the skin is worse."""

import dataclasses

import jax
import numpy as np
import pytest

from jeit import BoundaryElectrodes, Disk, ForwardModel, adjacent, one_step, ring
from jeit.touch import CellFinder, touch_attributes
from jeit.touch.simulate import DiscIndenter, MovingPress, Press, PressedSkin, material

KEY = jax.random.key(1)


def film(noise):
    """Presses on a skin of 100 mm at a multiple of the film's noise, its imager, its contact finder, and the skin."""
    electrodes = BoundaryElectrodes(ring(0.05, 16), width=0.008, contact_impedance=300.0)
    fine, model = (ForwardModel(Disk(0.05).mesh(num_points=n), electrodes, adjacent(16)) for n in (1200, 500))
    own = material("velostat")
    skin = PressedSkin(jax.random.key(0), fine, dataclasses.replace(own, noise=noise * own.noise))

    def press(touches):
        presses = [tuple(Press(DiscIndenter(d), n, place) for place, n, d in discs) for discs in touches]
        return skin.frames(jax.random.key(2), presses)

    return press, one_step(model, 2e-5), CellFinder(model.mesh), skin


@pytest.mark.slow
def test_a_film_and_a_noisy_one():
    *quiet_film, skin = film(1.0)
    seconds = np.arange(0, 1.5, 1 / 60)
    motion = MovingPress(DiscIndenter(0.01), np.where((seconds > 0.2) & (seconds < 0.7), 1.0, 0.0))
    recording = seconds, skin.record(jax.random.key(3), motion, seconds)
    quiet = touch_attributes(KEY, *quiet_film, recording=recording)
    noisy = touch_attributes(KEY, *film(10.0)[:3])
    assert quiet.localisation.missed == 0
    assert quiet.localisation.mean < 3e-3
    assert (quiet.weber < 0.1).all()
    assert np.median(noisy.weber) > 3 * np.median(quiet.weber)
    assert noisy.localisation.mean > quiet.localisation.mean
    assert 0.015 < quiet.two_points < 0.05
    assert quiet.area.correlation > 0.8
    assert quiet.rise is not None
    assert 0 <= quiet.rise < 0.2
    assert quiet.fall is not None
    assert 0 < quiet.fall < 0.5
    assert noisy.rise is None


PRESS, LINEAR, FINDER, _ = film(1.0)
BAD = {
    "no load": (lambda: touch_attributes(KEY, PRESS, LINEAR, FINDER, load=0.0), "load must be positive"),
    "no disc": (lambda: touch_attributes(KEY, PRESS, LINEAR, FINDER, diameter=-1.0), "diameter must be positive"),
    "nowhere": (lambda: touch_attributes(KEY, PRESS, LINEAR, FINDER, within="here"), "within must be positive"),
    "no middle": (lambda: touch_attributes(KEY, PRESS, LINEAR, FINDER, middle=0.0), "middle must be"),
    "a seed": (lambda: touch_attributes(0, PRESS, LINEAR, FINDER), "key"),
    "a skin": (lambda: touch_attributes(KEY, None, LINEAR, FINDER), "press"),
    "no image": (lambda: touch_attributes(KEY, PRESS, None, FINDER), "linear"),
    "no finder": (lambda: touch_attributes(KEY, PRESS, LINEAR, None), "finder"),
    "few frames": (lambda: touch_attributes(KEY, lambda some: np.ones((3, 208)), LINEAR, FINDER), "one for each touch"),
    "NaN": (lambda: touch_attributes(KEY, lambda some: np.full((50, 208), np.nan), LINEAR, FINDER), "finite volts"),
}


@pytest.mark.parametrize("name", BAD)
def test_bad_input(name):
    call, message = BAD[name]
    with pytest.raises(ValueError, match=message):
        call()
