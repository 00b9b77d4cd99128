"""The interactive view, rendered off screen: the objects in the scene, and an image that is not empty."""

import os
import socket
import subprocess
import sys
from importlib.util import find_spec

import numpy as np
import pytest

from jeit.electrodes import FacePatches
from jeit.image import Inclusion, SolidForm
from jeit.mesh import box, centroids
from jeit.plot import view_solid
from jeit.plot.solid import interactive
from jeit.plot.solid.interactive import can_view

TANK = box(0.17, 0.255, 0.17, num_points=600)
IMAGE = 1e-3 * np.exp(-np.sum((np.asarray(centroids(TANK)) - [0.03, -0.05, 0.1]) ** 2, axis=1) / 0.04**2)
PATCHES = FacePatches([[0.085, 0.0, 0.085], [-0.085, 0.0, 0.085]], 0.06, 0.06, 1e-3)
_DRAWS = """
import vtkmodules.vtkRenderingOpenGL2
from vtkmodules.vtkRenderingCore import vtkRenderer, vtkRenderWindow
window = vtkRenderWindow()
window.SetOffScreenRendering(1)
window.AddRenderer(vtkRenderer())
window.Render()
"""


@pytest.fixture(scope="module")
def pyvista():
    found = pytest.importorskip("pyvista", reason="PyVista is not installed (extra 'view')")
    # VTK ends the process if it finds no way to render, so test it in another process.
    tried = subprocess.run([sys.executable, "-c", _DRAWS], capture_output=True, timeout=120, env=os.environ)
    if tried.returncode:
        pytest.skip("VTK cannot draw off screen here")
    return found


def test_error_without_pyvista_says_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "pyvista", None)
    with pytest.raises(ImportError, match=r"pip install 'jeit\[view\]'"):
        view_solid(TANK, IMAGE)


def test_invalid_input_is_refused_before_pyvista_is_imported(monkeypatch):
    monkeypatch.setitem(sys.modules, "pyvista", None)
    with pytest.raises(ValueError, match="values has shape"):
        view_solid(TANK, np.zeros(3))
    with pytest.raises(ValueError, match="levels must be"):
        view_solid(TANK, IMAGE, levels=(2.0,))


def test_a_window_needs_a_display(monkeypatch):
    monkeypatch.setattr(sys, "platform", "linux")
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    assert ("display" if find_spec("pyvista") else "pip install") in can_view()


@pytest.mark.skipif(sys.platform != "linux", reason="displays of X11 on Linux")
def test_a_display_that_does_not_answer_is_none(monkeypatch):
    """A terminal may keep the name of a display that is gone: then no window opened and no pictures were made."""
    monkeypatch.setattr(interactive, "find_spec", lambda name: name)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    monkeypatch.setenv("DISPLAY", ":4242.0")
    assert can_view() == "nothing answers at DISPLAY=:4242.0"
    with socket.socket(socket.AF_UNIX) as server:
        server.bind("\0/tmp/.X11-unix/X4242")
        server.listen()
        assert can_view() == ""


def test_the_scene_contains_every_requested_object(pyvista, tmp_path):
    ball = Inclusion(1, (0.03, -0.05, 0.1), 1e-4, 1e-3)
    form = SolidForm((0.0, 0.0, 0.085), ((0.03, 0.0, 0.0), (0.0, 0.01, 0.0), (0.0, 0.0, 0.085)), True)
    found = [ball, Inclusion(1, (0.0, 0.0, 0.085), 1e-4, 1e-3, form=form)]
    plotter = view_solid(TANK, IMAGE, PATCHES, levels=(0.3, 0.6), inclusions=found, off_screen=True)
    named = {"hull", "edges", "isosurface 0", "isosurface 1", "electrodes", "inclusion 0", "inclusion 1", "plane"}
    assert named <= set(plotter.actors)
    assert list(plotter.scalar_bars.keys()) == ["Change of conductivity\n(µS/m)"]
    np.testing.assert_allclose(np.ptp(plotter.actors["inclusion 1"].mapper.dataset.points, axis=0), [60, 20, 170])
    hull, electrodes = (plotter.actors[name].mapper.dataset for name in ("hull", "electrodes"))
    np.testing.assert_allclose(np.ptp(hull.points, axis=0), [170, 255, 170], rtol=1e-6)
    assert electrodes.area == pytest.approx(2 * 60 * 60, rel=1e-6)
    picture = plotter.screenshot(str(tmp_path / "view.png"))
    plotter.close()
    assert picture.std() > 10
    reddest = picture[..., 0].astype(int) - picture[..., 2]
    assert (reddest > 60).sum() > 500
