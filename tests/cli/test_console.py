"""Numbers and tables as the commands print them."""

import contextlib
import io
from types import SimpleNamespace
from typing import Any

import pytest
from rich.console import Console

from jeit.arguments import percent
from jeit.cli import console as console_room
from jeit.cli.commands.reconstruct import bodies_text
from jeit.cli.console import (
    Steps,
    format_in_one_unit,
    format_with_unit,
    inclusion_table,
    quantity_table,
    smallest_body_text,
)
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
def test_percentages_have_no_exponents(value):
    assert percent(value) == SAID[value]


def test_unknown_values():
    assert percent(None) == "not known"


def printed(bodies, **known):
    console = Console(width=80, file=io.StringIO(), record=True)
    console.print(inclusion_table(bodies, "S/m", **known))
    return [line.split() for line in console.export_text().splitlines()]


BODIES = [Inclusion(1, (0.01, 0.02, 0.03), 2e-5, 0.2), Inclusion(-1, (0.0, 0.0, 0.0), 1e-5, -0.004)]


def test_a_peak_has_one_unit():
    lines = printed(BODIES)
    assert [line[0] for line in lines] == ["volume", "inclusion", "conductive", "resistive"]
    assert [line[-1] for line in lines] == ["change", "mS/m", "200", "-4"]


def test_a_peak_is_printed_as_a_change_and_relative_to_the_background():
    lines = printed(BODIES, background=0.05)
    assert lines[0][-4:] == ["peak", "change", "of", "back-"]
    assert lines[1][-3:] == ["/", "mS/m", "ground"]
    assert [line[-4:] for line in lines[2:]] == [["20.00", "200", "400", "%"], ["10.00", "-4", "-8", "%"]]


def body_with_intervals(kind, **more):
    place, strength = (-0.2595, -0.1297, 0.1477), (0.0098765, 0.0098765)
    known = {"contrast_interval": (110.1, 130.1), "area_interval": (0.0109, 0.0135), "strength_interval": strength}
    known["centroid_radius"] = 0.01234
    return Inclusion(kind, place, 0.0123456, 0.205 * 120.5, strength=strength[0], **known, **more)


def quantities(bodies):
    console = Console(width=80, file=io.StringIO(), record=True)
    console.print(quantity_table(bodies, 0.205))
    return [line.split() for line in console.export_text().splitlines()]


def test_numbers_of_a_large_body_have_three_digits_and_no_exponents():
    words = {word for line in quantities([body_with_intervals(1)]) for word in line}
    assert {"12300", "10900", "13500", "9880", "+11000", "+13000", "±12"} <= words


def test_column_headings():
    """Headings take one line where the whole table fits into 80 columns."""
    form = SolidForm((0.0, 0.0, 0.0), ((0.01, 0.0, 0.0), (0.0, 0.01, 0.0), (0.0, 0.0, 0.05)), True)
    column = Inclusion(1, (-0.2595, -0.1297, 0.1477), 0.0123456, 0.999, form=form)
    first = [line[:2] for line in printed([column, BODIES[1]]) if line]
    assert [first[-2], first[-1][0]] == [["conductive", "column"], "resistive"]
    lines = quantities([body_with_intervals(1, form=form), body_with_intervals(-1)])
    assert [line[0] for line in lines if line and line[0].isalpha()][-3:] == ["conductive", "column", "resistive"]


@pytest.mark.parametrize(("dimension", "edge"), [(2, "outlines"), (3, "surfaces")])
def test_extent_of_bodies_is_an_outline_in_a_sheet_and_a_surface_in_a_solid(dimension, edge):
    determined, undetermined = (SimpleNamespace(contrast_is_determined=known) for known in (True, False))
    shapes: Any = SimpleNamespace(bodies=[determined, undetermined], doubtful=[determined], drift=0.01)
    assert bodies_text(shapes, dimension) == (
        f"2 {edge} fitted; 1 ghost left out; of 1 the data give a limit of the change only; the background "
        "has drifted by 1 %"
    )


def test_durations_are_rounded_to_the_accuracy_of_an_estimate():
    said = {0.2: "0 s", 9.4: "9 s", 10.6: "10 s", 13.0: "15 s", 97.0: "95 s", 130.0: "2 min", 5300.0: "88 min"}
    said |= {5500.0: "1.5 h", 86400.0: "24.0 h"}
    assert {seconds: console_room._rounded_duration(seconds) for seconds in said} == said


def test_steps_are_printed_with_their_duration_once_they_end(monkeypatch):
    """The last one too, but not one that fails; nothing is printed on request."""
    now, printed = [100.0], {}
    monkeypatch.setattr(console_room.time, "perf_counter", lambda: now[0])
    for quiet in (False, True):
        file = io.StringIO()
        with contextlib.suppress(KeyError), Steps(Console(file=file), quiet=quiet) as step:
            assert step.current_step_name == ""
            for name, seconds in (("read", 0.04), ("image", 12.34), ("write", 1.0)):
                step(name)
                step.report("half")
                assert step.current_step_name == name
                now[0] += seconds
            raise KeyError
        printed[quiet] = [line.split() for line in file.getvalue().splitlines()]
    assert printed == {False: [["read", "0.0", "s"], ["image", "12.3", "s"]], True: []}
    with Steps(Console(file=(file := io.StringIO())), quiet=False) as step:
        step("read")
    assert file.getvalue().split() == ["read", "0.0", "s"]


def test_values_have_the_prefix_that_suits_them():
    said = {None: "not known", 0.0: "0 S", 1.234: "1.23 S", -0.0567: "-56.7 mS", 9.996e-4: "1 mS", 9.99e-7: "999 nS"}
    said |= {2e-10: "2e-10 S", 1234.0: "1.23e+03 S"}
    assert {value: format_with_unit(value, "S") for value in said} == said
    for values, unit, texts in (
        ([2e-6, -3.456e-3], "mS", ["0.002", "-3.46"]),
        ([9.996e-4, 2e-5], "mS", ["1", "0.02"]),
        ([0.0], "S", ["0"]),
        ([], "S", []),
    ):
        assert format_in_one_unit(values, "S") == (unit, texts)


def test_smallest_bodies_that_are_not_detected_have_no_size():
    def text(median, almost_everywhere):
        names = "diameter_in_half_of_the_domain", "diameter_almost_everywhere"
        return smallest_body_text({**dict(zip(names, (median, almost_everywhere), strict=True)), "limited_by": "noise"})

    found = "an insulating body 12 mm across is detected at half of all places, "
    assert text(0.0123, 0.02) == found + "one of 20 mm at 95 %; limited by noise"
    assert text(0.0123, None) == text(0.0123, float("inf")) == found + "none at most others; limited by noise"
    assert text(float("inf"), None).startswith("none: the noise exceeds")
    assert smallest_body_text({"not_known_because": "no noise"}) == "not known: no noise"


def test_the_time_left_is_estimated_where_parts_are_known(monkeypatch):
    """At the pace so far; of steps whose number of parts is not known nothing is estimated."""
    now = [100.0]
    monkeypatch.setattr(console_room.time, "perf_counter", lambda: now[0])
    with Steps(Console(file=io.StringIO(), force_terminal=True), quiet=False) as step:

        def shown(seconds, detail):
            step("image")
            now[0] += seconds
            step.report(detail)
            return str(step._spinner.status.__rich__())

        assert shown(4, "frame 10 of 40") == "image … frame 10 of 40  4 s, about 10 s left"
        assert shown(60, "1,000 of 4,000 films") == "image … 1,000 of 4,000 films  60 s, about 3 min left"
        assert shown(7200, "2 of 4") == "image … 2 of 4  7200 s, about 2.0 h left"
        assert shown(4, "step 10 of at most 40") == "image … step 10 of at most 40  4 s"
        assert shown(4, "1 of 100") == "image … 1 of 100  4 s"
        assert shown(1, "20 of 100") == "image … 20 of 100"
        assert shown(4, "40 of 40") == "image … 40 of 40  4 s"
