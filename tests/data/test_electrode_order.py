"""Electrodes that are not numbered along the edge are reported, with whether the voltages agree."""

import numpy as np
import pytest

from jeit.data import read, screen
from jeit.electrodes import BoundaryElectrodes, PointElectrodes
from jeit.layout import ring
from jeit.mesh import Disk
from jeit.protocol import adjacent

RADIUS, NUMBER = 0.1, 16
PROTOCOL = adjacent(NUMBER)


def measured(tank, rows, kind=BoundaryElectrodes, wired=None):
    """Notes on a tank whose electrodes are wired in the order `wired`, with positions in the order of `rows`."""
    position = ring(RADIUS, NUMBER, clockwise=True)
    voltages = tank(PROTOCOL if wired is None else rewired(wired))
    electrodes = kind(position[rows], 1e-3, 0.01) if kind is BoundaryElectrodes else kind(position[rows])
    return screen(voltages, PROTOCOL, electrodes=electrodes, domain=Disk(RADIUS)).notes


def rewired(order):
    """The protocol on a ring whose k-th place has electrode order[k]."""
    import equinox as eqx

    drive, measurement = (np.asarray(part)[:, order] for part in (PROTOCOL.drive, PROTOCOL.measurement))
    return eqx.tree_at(lambda one: (one.drive, one.measurement), PROTOCOL, (drive, measurement))


def exchanged(*pairs):
    rows = np.arange(NUMBER)
    for one, other in pairs:
        rows[[one, other]] = rows[[other, one]]
    return rows


@pytest.mark.parametrize("rows", [np.arange(16), np.arange(16)[::-1], np.roll(np.arange(16), 5)])
def test_rings_in_either_direction_are_in_order(tank, rows):
    assert measured(tank, rows, wired=np.argsort(rows)) == ()


def test_two_exchanged_rows_are_reported_and_contradicted_by_the_voltages(tank):
    (note,) = measured(tank, exchanged((4, 5)))
    assert "come in the order 1, 2, 3, 4, 6, 5, 7, 8" in note
    assert "the voltages contradict it" in note
    assert "% if the electrodes followed each other by their numbers" in note
    assert " 0 % if" in note
    assert "exchanged: mend them" in note


def test_a_layout_numbered_in_another_order_agrees_with_its_voltages(tank):
    rows = np.argsort(np.r_[np.arange(0, 16, 2), np.arange(1, 16, 2)])
    (note,) = measured(tank, rows, wired=np.argsort(rows))
    assert note.endswith("; the signs of the voltages agree.")


def test_point_electrodes_are_not_checked(tank):
    assert measured(tank, exchanged((4, 5)), kind=PointElectrodes) == ()


def test_a_shuffled_ring_is_reported_by_the_commands(tank, tmp_path, capsys):
    from jeit.cli import main

    positions = ring(RADIUS, NUMBER, clockwise=True)[exchanged((2, 9))].tolist()
    (tmp_path / "d.toml").write_text(
        f'[geometry]\nshape = "disk"\nradius = {RADIUS}\n[electrodes]\npositions = {positions}\nwidth = 0.001\n'
        'contact_impedance = 0.01\n[protocol]\nkind = "adjacent"\ncurrent = 1.0\n'
    )
    np.savetxt(tmp_path / "a.csv", tank(adjacent(NUMBER, current=1.0))[None], delimiter=",")
    assert main(["info", str(tmp_path / "a.csv"), "--description", str(tmp_path / "d.toml")]) == 0
    assert "the voltages contradict it" in " ".join(capsys.readouterr().out.split())
    (note,) = read(tmp_path / "a.csv", description=tmp_path / "d.toml").notes
    assert "1, 2, 10, 4" in note
