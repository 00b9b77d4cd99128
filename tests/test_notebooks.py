"""Representation of objects in consoles and notebooks: two lines of text, and a picture."""

import html

import equinox as eqx
import jax
import numpy as np
import pytest

from jeit.data.round_skin import RoundSkin, simulate_press
from jeit.design import Skin
from jeit.image import ImageSeries, Raster, figures_of_merit
from jeit.imaging import ImagingSettings, image_difference
from jeit.inverse import Imager, one_step
from jeit.layout import named_layout
from jeit.mesh import Disk, Rectangle, Solid, centroids, surface_of
from jeit.report import notebook


@pytest.fixture(scope="module")
def shown():
    """Objects of every class with a text or picture representation, by name."""
    pressed, rest = simulate_press(RoundSkin(), jax.random.key(0), (0.02, 0.01), noise=1e-4)
    imaged = image_difference(pressed, rest, ImagingSettings(num_points=300))
    model = imaged.calibration.model
    swing = np.ones((3, model.mesh.num_cells))
    raster = Raster.create(model.mesh, shape=(24, 24))
    place = np.array([[0.0, 0.0], [0.02, 0.01]])
    blurred = [np.exp(-((np.asarray(centroids(model.mesh)) - one) ** 2).sum(axis=1) / 2e-4) for one in place]
    merit = figures_of_merit(raster.sample(np.array(blurred)), raster.extent, place, area=1e-4)
    layout = named_layout("grid-3x3", Rectangle(0.1, 0.1))
    return {
        "measurement": pressed,
        "imaged": imaged,
        "calibration": imaged.calibration,
        "model": model,
        "mesh": model.mesh,
        "protocol": model.protocol,
        "linear": one_step(model, 1.0, hyperparameter=0.1),
        "imager": Imager.create(model, 1.0, reference=model.voltages(1.0)),
        "series": ImageSeries(model.mesh, swing, np.arange(3.0)),
        "layout": layout,
        "skin": Skin.create(layout, num_layers=0, cell_size=8e-3),
        "merit": merit,
        "surface": surface_of(Solid(Disk(0.1), 0.05).mesh(num_points=300)),
    }


@pytest.fixture(scope="module", autouse=True)
def pictures_drawn_once():
    """Both representations call `picture`, and most of the time is drawing."""
    draw, drawn = notebook.picture, {}

    def drawn_once(value):
        if id(value) not in drawn:
            drawn[id(value)] = value, draw(value)  # with the object, so that its number is not given to another
        return drawn[id(value)][1]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(notebook, "picture", drawn_once)
        yield


PICTURES = ("measurement", "merit", "imaged", "mesh", "series", "layout", "skin", "surface")


def test_reprs_are_short(shown):
    for name, one in shown.items():
        text = repr(one)
        assert type(one).__name__ in text, name
        assert text.count("\n") <= 2, name
        assert len(text) < 330, name
    assert "208 channels" in repr(shown["protocol"])
    assert f"amplitude response {np.median(shown['merit'].amplitude_response):.3g}," in repr(shown["merit"])
    assert "1 inclusions" in repr(shown["imaged"]) or "inclusions in" in repr(shown["imaged"])


@pytest.mark.parametrize("name", PICTURES)
def test_pictures_are_drawn(shown, name):
    drawn = shown[name]._repr_png_()
    assert drawn.startswith(b"\x89PNG")
    assert len(drawn) > 5_000


def test_html_representations(shown):
    """The text and the picture as HTML without scripts."""
    for name in PICTURES:
        page = shown[name]._repr_html_()
        assert page.startswith(f"<pre>{html.escape(repr(shown[name]))}</pre><img"), name
        assert "data:image/png;base64,iVBOR" in page, name
        assert "<script" not in page


def test_traced_objects_have_neither_values_nor_pictures(shown):
    mesh = shown["mesh"]

    @jax.jit
    def seen(points):
        traced = eqx.tree_at(lambda one: one.points, mesh, points)
        assert traced._repr_png_() is None
        assert traced._repr_html_() is None
        assert repr(traced).startswith("Mesh(")
        return points.sum()

    seen(mesh.points)
    assert repr(eqx.filter(shown["protocol"], lambda one: False)) == "<Protocol>"


def test_jit_of_a_method(shown):
    """Compiled with the model's arrays as constants."""
    model = shown["model"]
    compiled = jax.jit(model.voltages)
    np.testing.assert_allclose(compiled(2.0), model.voltages(2.0), rtol=1e-8)
    assert hash(model.voltages) == hash(model.voltages)
    assert model.voltages == model.voltages
    assert model.voltages != model.jacobian
    assert "volts" in type(model).voltages.__doc__


@pytest.mark.slow
def test_derivatives_with_respect_to_a_model_within_jit(shown):
    model = shown["model"]

    def power(contact):
        there = model.with_electrodes(model.electrodes.with_contact_impedance(contact))
        return jax.jit(there.voltages)(1.0) @ np.ones(model.protocol.num_measurements)

    slope = jax.grad(power)(jax.numpy.asarray(model.electrodes.contact_impedance))
    assert np.isfinite(slope).all()
