"""A described body in another unit than metres gives one warning, with the keys of its description."""

import warnings

import numpy as np
import pytest

from jeit.data.description import parse_description
from jeit.mesh import Disk, bisect, box, cylinder, write

LARGE = {
    "a cylinder in centimetres": (
        {"shape": "cylinder", "radius": 15, "height": 10},
        r"geometry\.radius: 15 m is large .* millimetres, give 0\.015, if centimetres, 0\.15, if inches, 0\.381,",
    ),
    "a cylinder taller than ten": (
        {"shape": "cylinder", "radius": 15, "height": 12},
        r"geometry\.radius, geometry\.height: 15 m and 12 m are large .* if centimetres, 0\.15 and 0\.12,",
    ),
    "a disk with a thickness": (
        {"shape": "disk", "radius": 0.1, "thickness": 20},
        r"geometry\.thickness: 20 m is large .* if centimetres, 0\.2,",
    ),
    "a radius of less than ten": (
        {"shape": "cylinder", "radius": 8, "height": 4},
        r"geometry\.radius: 8 m is large .* if centimetres, 0\.08,",
    ),
    "a box": ({"shape": "box", "width": 30, "depth": 9, "height": 5}, r"geometry\.width: 30 m is large .*, 0\.3,"),
    "a polygon": (
        {"shape": "polygon", "vertices": [[0, 0], [30, 0], [30, 20]], "thickness": 5},
        r"geometry\.vertices: 30 m is large .* if centimetres, 0\.01 times those,",
    ),
    "a mesh": ({"mesh": "disk.vtu", "scale": 10}, r"geometry\.mesh: 79\.9 m is large .* if centimetres, scale = 0\.1,"),
}


@pytest.mark.parametrize("name", LARGE)
def test_one_warning_with_the_keys(name, tmp_path):
    geometry, message = LARGE[name]
    write(Disk(4.0).mesh(num_points=100), tmp_path / "disk.vtu")
    with pytest.warns(UserWarning, match=rf"^tank\.toml: {message}") as found:
        meshed_twice({"geometry": geometry}, tmp_path)
    assert len(found) == 1


def meshed_twice(described, folder):
    """Mesh a described body, and refine the mesh."""
    body = parse_description(described, "tank.toml", folder).domain
    assert body is not None
    bisect(body.mesh(num_points=300), lambda corners: np.full(len(corners), 10.0))


def test_a_body_in_metres_gives_no_warning():
    parse_description({"geometry": {"shape": "cylinder", "radius": 4.9, "height": 9.9}}, "tank.toml")


@pytest.mark.parametrize(
    ("make", "name"),
    [
        (lambda: Disk(15.0).mesh(num_points=100), "radius"),
        (lambda: Disk(8.0).mesh(num_points=100), "radius"),
        (lambda: cylinder(15.0, 10.0, num_points=200), "radius"),
        (lambda: box(15.0, 9.0, 8.0, num_points=200), "width"),
    ],
)
def test_a_size_in_python_gives_one_warning(make, name):
    with pytest.warns(UserWarning, match=f"^{name}: .* m is large") as found:
        make()
    assert len(found) == 1


def test_a_later_call_warns_again():
    for _ in range(2):
        with pytest.warns(UserWarning, match="^radius"):
            Disk(15.0).mesh(num_points=100)


def test_the_command_prints_a_warning_once(capsys):
    from jeit.cli import app

    with warnings.catch_warnings():
        show = app._create_warning_printer()
        for line in (1, 2):
            show(UserWarning("large"), UserWarning, "a.py", line)
        show(UserWarning("small"), UserWarning, "a.py", 1)
    assert capsys.readouterr().err == "jeit: warning: large\njeit: warning: small\n"
