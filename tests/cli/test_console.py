"""Numbers as the commands print them."""

import io

import pytest
from rich.console import Console

from jeit.arguments import percent
from jeit.cli.console import inclusion_table
from jeit.image import Inclusion

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


def test_a_peak_is_told_with_what_it_may_lie_between():
    """In one unit, each beside its own body; nothing where it is not known."""
    bodies = [Inclusion(1, (0.01, 0.02, 0.03), 2e-5, 0.2), Inclusion(-1, (0.0, 0.0, 0.0), 1e-5, -0.004)]

    def printed(*ranges):
        console = Console(width=80, file=io.StringIO(), record=True)
        console.print(inclusion_table(bodies, "S/m", *ranges))
        return [line.split() for line in console.export_text().splitlines()]

    known = printed([(0.1, 0.4), (-0.005, -0.002)])
    assert [line[0] for line in known] == ["inclusion", "conductive", "resistive"]
    assert known[0][-3:] == ["±", "1", "σ"]
    assert known[1][-4:] == ["200", "100", "to", "400"]
    assert known[2][-4:] == ["-4", "-5", "to", "-2"]
    assert [line[-1] for line in printed()] == ["mS/m", "200", "-4"]
