"""Numbers as the commands print them."""

import io
from types import SimpleNamespace
from typing import Any

import pytest
from rich.console import Console

from jeit.arguments import percent
from jeit.cli.commands.reconstruct import bodies_text
from jeit.cli.console import inclusion_table
from jeit.image import Inclusion, SolidForm

SAID = {
    0.0: "0 %",
    1e-14: "less than 0.001 %",
    -2e-6: "less than 0.001 %",
    2.34e-5: "0.0023 %",
    0.0123: "1.2 %",
    0.994: "99 %",
    0.996: "100 %",
    -1.0: "-100 %",
    -1.26: "-126 %",
    123.4: "12340 %",
}


@pytest.mark.parametrize("value", SAID)
def test_per_cents_have_no_exponents(value):
    assert percent(value) == SAID[value]


def test_what_is_not_known():
    assert percent(None) == "not known"


def printed(bodies, *ranges, **known):
    console = Console(width=80, file=io.StringIO(), record=True)
    console.print(inclusion_table(bodies, "S/m", *ranges, **known))
    return [line.split() for line in console.export_text().splitlines()]


BODIES = [Inclusion(1, (0.01, 0.02, 0.03), 2e-5, 0.2), Inclusion(-1, (0.0, 0.0, 0.0), 1e-5, -0.004)]


def test_a_peak_is_told_with_what_it_may_lie_between():
    """In one unit, each beside its own body; nothing where it is not known."""
    known = printed(BODIES, [(0.1, 0.4), (-0.005, -0.002)])
    assert [line[0] for line in known] == ["volume", "inclusion", "conductive", "resistive"]
    assert known[1][-3:] == ["±", "1", "σ"]
    assert known[2][-4:] == ["200", "100", "to", "400"]
    assert known[3][-4:] == ["-4", "-5", "to", "-2"]
    assert [line[-1] for line in printed(BODIES)] == ["change", "mS/m", "200", "-4"]


def test_a_peak_is_told_as_a_change_and_with_the_share_of_the_background_that_it_is():
    lines = printed(BODIES, background=0.05)
    assert lines[0][-4:] == ["peak", "change", "of", "back-"]
    assert lines[1][-3:] == ["/", "mS/m", "ground"]
    assert [line[-3:] for line in lines[2:]] == [["200", "400", "%"], ["-4", "-8", "%"]]


def test_all_that_is_known_of_a_large_body_goes_on_a_line():
    bodies = [Inclusion(1, (-0.2595, -0.1297, 0.1477), 0.0123456, 0.999), Inclusion(-1, (0.0,) * 3, 1e-5, -0.25)]
    lines = printed(bodies, [(0.529, 0.9999), (-0.4567, -0.111)], background=0.205)
    assert len(lines) == 4
    assert lines[3][-6:] == ["-0.25", "-0.457", "to", "-0.111", "-122", "%"]


def test_columns_are_called_so():
    """On one line where all of the table goes into 80 columns."""
    form = SolidForm((0.0, 0.0, 0.0), ((0.01, 0.0, 0.0), (0.0, 0.01, 0.0), (0.0, 0.0, 0.05)), True)
    column = Inclusion(1, (-0.2595, -0.1297, 0.1477), 0.0123456, 0.999, form=form)
    first = [line[:2] for line in printed([column, BODIES[1]]) if line]
    assert [first[-2], first[-1][0]] == [["conductive", "column"], "resistive"]
    lines = printed([column, BODIES[1]], [(0.529, 0.9999), (-0.4567, -0.111)], background=0.205)
    assert [line[0] for line in lines if line][-3:] == ["conductive", "column", "resistive"]


@pytest.mark.parametrize(("dimension", "edge"), [(2, "outlines"), (3, "surfaces")])
def test_bodies_end_at_outlines_in_a_sheet_and_at_surfaces_in_a_solid(dimension, edge):
    told, strong = (SimpleNamespace(contrast_is_determined=known) for known in (True, False))
    shapes: Any = SimpleNamespace(bodies=[told, strong], doubtful=[told], drift=0.01)
    assert bodies_text(shapes, dimension) == (
        f"2 {edge} fitted; 1 ghost left out; 1 so strong that the data give a limit of the change only; the background "
        "has drifted by 1 %"
    )
