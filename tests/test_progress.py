"""Long computations report their progress: `progress=` of the public functions is called with texts."""

import inspect

import jax
import numpy as np
import pytest

from jeit import acoustic, design, imaging, inverse, report, touch
from jeit.acoustic import Taps, calibrate_microphones
from jeit.acoustic.simulate import SoundingSkin, microphone_grid, simulate_calibration_taps
from jeit.electrodes import BoundaryElectrodes
from jeit.forward import ForwardModel
from jeit.inverse import compare_rules
from jeit.layout import ring
from jeit.mesh import Disk
from jeit.protocol import adjacent
from jeit.touch.simulate import MovingPress, Press, PressedSkin, ball_indenter, material

KEY = jax.random.key(0)
LONG = [
    acoustic.calibrate_microphones,
    acoustic.locate_touches,
    design.compare_layouts,
    design.improve_layout,
    design.run_study,
    imaging.compare_on_data,
    imaging.image_difference,
    imaging.prepare_imager,
    inverse.compare_rules,
    report.write_film,
    report.write_stream,
    touch.simulate.PressedSkin.frames,
    touch.simulate.PressedSkin.record,
    acoustic.simulate_calibration_taps,
    touch.simulate.simulate_presses,
    touch.LearntSkin.fit,
]


@pytest.mark.parametrize("function", LONG, ids=lambda function: function.__qualname__)
def test_functions_accept_progress(function):
    assert "progress" in inspect.signature(function).parameters


@pytest.fixture(scope="module")
def model():
    return ForwardModel(Disk(0.05).mesh(num_points=100), BoundaryElectrodes(ring(0.05, 8), 0.008, 0.2), adjacent(8))


def test_rules_are_reported(model):
    reported, difference = [], 1e-3 * np.asarray(model.voltages(1.0)) * np.random.default_rng(0).normal(size=40)
    found = compare_rules(model, 1.0, difference=difference, progress=reported.append)
    assert reported == ["linearise", *found]


def test_presses_are_counted(model):
    skin, reported = PressedSkin(KEY, model, material("velostat")), []
    presses = [Press(ball_indenter(0.02), 1.0, (0.001 * k, 0.0)) for k in range(5)]
    frames = skin.frames(KEY, presses, progress=reported.append)
    assert reported[-1] == "voltages: 5 of 5"
    assert "pressure: 5 of 5" in reported
    np.testing.assert_array_equal(frames, skin.frames(KEY, presses))
    reported.clear()
    skin.record(KEY, MovingPress(ball_indenter(0.02), np.ones(5)), np.arange(5.0), progress=reported.append)
    assert reported[-1] == "voltages: 5 of 5"


@pytest.mark.slow
def test_taps_and_their_calibration_report_their_steps():
    skin, reported, steps = SoundingSkin(KEY), [], []
    taps = simulate_calibration_taps(skin, KEY, microphone_grid(5), repeats=1, duration=0.08, progress=reported.append)
    assert reported[-1] == "25 of 25 places"
    corners = [[-0.1, -0.1], [0.1, -0.1], [0.1, 0.1], [-0.1, 0.1]]
    given = Taps(skin.microphones, corners, taps.positions, samples=taps.samples, rate=taps.rate)
    calibrate_microphones(given, decay="exponential", progress=steps.append)
    assert steps == ["measure intensities", "fit exponential"]
