"""Doubts about the data of a difference image, from frames and calibrations that are made up: each fault raises its
sentence, and sound data raise none."""

import re
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from jeit.arguments import percent
from jeit.electrodes import BoundaryElectrodes
from jeit.imaging.doubts import doubts_of_data
from jeit.layout import ring
from jeit.mesh import Disk


def calibration(background: float, dimension: int, **fields) -> Any:
    model = SimpleNamespace(mesh=SimpleNamespace(dimension=dimension))
    return SimpleNamespace(**{"conductivity": background, "misfit": 0.0, "model": model, **fields})


@pytest.mark.parametrize(
    ("background", "dimension", "left", "volts", "expected"),
    [
        (0.2, 3, 0.9, 0.1, []),
        (0.2, 3, 0.3, 0.1, ["only 3 of 10 voltages are left (30 %)"]),
        (220.0, 3, 0.9, 0.1, [r'is no water\'s.*, which conduct 0.001 to 30 S/m: \[protocol\] current_unit = "mA"\?$']),
        (
            2e-4,
            3,
            0.9,
            5.5,
            [r'a background of 0.0002 S/m is no water\'s.*: \[data\] unit = "mV" \(a back.*0.2 S/m\)\?$'],
        ),
        (2e-8, 3, 0.9, 5.5, [r'unit = "uV" \(a background of 0.02 S/m\)\?$']),
        (2e-8, 2, 0.9, 400.0, [r'no sheet\'s.*"mV" \(a background of 2e-05 S\) or "uV" .* They are whole numbers']),
        (2e-5, 2, 0.9, 90.5, [r'voltages of up to 90.5 V are beyond what instruments read: .* "mV" .* or "uV"']),
        (2e-5, 2, 0.9, 5.5, []),  # a skin of 50 kilohm per square
        (220.0, 2, 0.9, 0.1, []),  # sheets may have any
    ],
)
def test_thin_data_and_impossible_units_are_doubted(background, dimension, left, volts, expected):
    used = np.arange(10) < 10 * left
    frame: Any = SimpleNamespace(
        mask=used[None], voltages=np.full((1, 10), volts), notes=(), electrodes=None, domain=None
    )
    doubts = doubts_of_data(frame, frame, calibration(background, dimension))
    assert len(doubts) == len(expected)
    assert all(one in doubt or re.search(one, doubt) for one, doubt in zip(expected, doubts, strict=True))
    frame.notes = ("neither unit nor gain of the voltages is known: trust relative changes, not volts.",)
    assert len(doubts_of_data(frame, frame, calibration(background, dimension))) == (left < 0.5)


def test_files_are_not_taken_for_exchanged_because_of_the_scale_of_the_model():
    """The background may be fitted to the small voltages of a tank that differs from its model, and miss large ones."""
    rest = np.linspace(1.0, 3.0, 40)

    def frame(factor) -> Any:
        mask = np.ones((1, len(rest)), bool)
        mask[0, 3] = False
        return SimpleNamespace(voltages=(10 * rest * factor)[None], mask=mask, notes=(), electrodes=None, domain=None)

    def doubts(of_frame, of_reference):
        fitted = calibration(0.02, 2, voltages=1.4 * rest, misfit=0.4)
        return doubts_of_data(frame(of_frame), frame(of_reference), fitted)

    disturbed = 1 + 0.6 * np.cos(np.arange(len(rest)))
    weaker = 1 + 0.1 * np.cos(np.arange(len(rest)))
    assert doubts(1.02, 1.0) == doubts(disturbed, 1.0) == []
    assert "are the two exchanged?" in doubts(1.0, disturbed)[0]
    (exchanged,) = doubts(weaker, disturbed)
    shares = []
    for factor in (weaker, disturbed):
        predicted, measured = (np.delete(values, 3) for values in (rest, rest * factor))
        fitted = predicted * (predicted @ measured) / (predicted @ predicted)
        shares.append(percent(np.linalg.norm(measured - fitted) / np.linalg.norm(measured)))
    assert exchanged == (
        f"the frame fits an undisturbed body better ({shares[0]} misfit) than the reference does ({shares[1]}): "
        "are the two exchanged?"
    )


@pytest.mark.parametrize(
    ("width", "domain", "doubted"),
    [
        (2e-3, Disk(0.6), True),
        (3e-3, Disk(0.6), False),
        ([3e-3, *7 * [2e-3]], Disk(0.6), False),
        (2e-3, None, False),  # the body is not known
    ],
)
def test_electrodes_much_narrower_than_their_distance_are_doubted(width, domain, doubted):
    """Eight electrodes on a tank 1.2 m across, which are 471 mm apart."""
    electrodes = BoundaryElectrodes(ring(0.6, 8), width, 0.05)
    frame: Any = SimpleNamespace(
        mask=np.ones((1, 10), bool), voltages=np.full((1, 10), 0.1), notes=(), electrodes=electrodes, domain=domain
    )
    doubts = doubts_of_data(frame, frame, calibration(0.2, 2))
    expected = "the electrodes are 2 mm wide and 471 mm apart, on a body 1.2 m wide: are all lengths in metres?"
    assert doubts == ([expected] if doubted else [])
