"""Surfaces unfolded round places: distances as in the plane if the surface is developable, and the result if it is
not."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jeit.electrodes import SheetDiscs, SurfaceDiscs
from jeit.layout import grid
from jeit.mesh import Mesh, bend, forearm, rectangle, sphere, tube
from jeit.mesh.geodesic import Triangles, unfold
from jeit_solvers.engines import on_host

WEIGHTS = np.array([[1.0, 0, 0], [0.2, 0.3, 0.5]])


def bent_and_flat(radius=0.03, axis="y", sheet=None):
    """A sheet rolled round a cylinder, the plane mesh with the same cells, and places on both."""
    sheet = rectangle(0.12, 0.1, cell_size=4e-3) if sheet is None else sheet
    bent, flat = bend(sheet, radius, axis=axis), bend(sheet, np.inf, axis=axis)
    plane = Mesh.create(np.asarray(flat.points)[:, :2], flat.cells)
    centres = grid(0.08, 0.06, 3, 3) + 0.0011
    at = Triangles.of(flat).nearest(np.column_stack([centres, np.zeros(len(centres))]))
    places = np.einsum("pk,pkd->pd", at.weights, np.asarray(bent.points)[np.asarray(bent.cells)[at.triangle]])
    return bent, plane, places, centres


@pytest.mark.parametrize("axis", ["x", "y"])
@pytest.mark.parametrize("radius", [0.025, -0.04, 0.5])
def test_lengths_on_a_bent_sheet_equal_those_on_the_flat_one(axis, radius):
    bent, plane, places, centres = on_host(bent_and_flat(radius, axis))
    around = unfold(bent, places, np.full((9, 1), 0.02))
    assert around.exact.all()
    points = np.einsum("pk,mkd->mpd", WEIGHTS, plane.points[plane.cells])
    exact = np.linalg.norm(points[:, None] - centres[:, None], axis=-1)
    which = np.broadcast_to(np.arange(9), (len(points), 9))
    found = np.sqrt(around.squared(WEIGHTS, which))
    known, middles = around.reached.T, plane.points[plane.cells].mean(axis=1)
    assert known[np.linalg.norm(middles[:, None] - centres, axis=-1) < 0.02].all()
    np.testing.assert_allclose(found[known], exact[known], atol=1e-13)


def test_discs_on_a_bent_sheet_equal_those_on_the_flat_one():
    bent, plane, places, centres = on_host(bent_and_flat())
    found = on_host(SurfaceDiscs(places, 5e-3, 1e-3)).contact(bent)
    exact = on_host(SheetDiscs(centres, 5e-3, 1e-3)).contact(plane)
    for one, other in ((found.load, exact.load), (found.mass[0], exact.mass[0])):
        np.testing.assert_allclose(one, other, atol=1e-12 * float(np.abs(other).max()))


@pytest.mark.slow
def test_discs_in_a_batch_equal_those_of_a_loop():
    bent, _, places, _ = on_host(bent_and_flat())
    found = on_host(SurfaceDiscs(places, 5e-3, 1e-3)).contact(bent)
    through = SurfaceDiscs(places, 5e-3, 1e-3)
    moved = jax.jit(jax.vmap(lambda at: eqx.tree_at(lambda one: one.position, through, at).contact(bent).load))
    both = moved(np.stack([places, places[::-1]]))
    backwards = on_host(SurfaceDiscs(places[::-1], 5e-3, 1e-3)).contact(bent)
    for mine, theirs in zip(both, (found.load, backwards.load), strict=True):
        np.testing.assert_allclose(mine, theirs, atol=1e-12 * float(np.abs(found.load).max()))


@jax.jit
def load_and_slope(cells, points, nodes, places, along):
    """Contact loads of discs on a surface whose nodes and places move, and their derivative."""

    def load(size):
        return SurfaceDiscs(places + size * along, 6e-3, 1e-3).contact(moved(cells, points + size * nodes)).load

    return jax.jvp(load, (0.0,), (1.0,))


def moved(surface, points):
    return eqx.tree_at(lambda one: one.points, surface, points)


@pytest.mark.parametrize(
    "kind", ["bent", "domed", *(pytest.param(one, marks=pytest.mark.slow) for one in ("tube", "forearm", "sphere"))]
)
def test_contacts_are_differentiable_in_places_and_nodes(kind):
    """On a bent sheet, which is developable, and on the same sheet as a dome, which is not."""
    surface, dome = None, None
    if kind in ("bent", "domed"):
        surface, flat, _, _ = bent_and_flat()
        x, y = np.asarray(flat.points).T
        dome = moved(surface, jnp.asarray(np.stack([x, y, -10 * (x**2 + y**2)], axis=1)))
    surface = {
        "bent": lambda: surface,
        "domed": lambda: dome,
        "tube": lambda: tube(0.03, 0.1, num_points=900),
        "forearm": lambda: forearm(0.12, (0.03, 0.022), 0.04, num_points=900),
        "sphere": lambda: sphere(0.04, num_points=900),
    }[kind]()
    triangles = Triangles.of(surface)
    towards = {"bent": [[0.01, 0.013, 0], [-0.03, -0.02, -0.02]], "domed": [[0.01, 0.013, 0], [-0.03, -0.02, 0]]}
    places = triangles.nearest(towards.get(kind, [[0.04, 0.003, 0.051], [0.0, -0.04, 0.06]]))
    normal = triangles.normals[places.triangle]
    key = np.random.default_rng(1)
    along = key.normal(size=(2, 3))
    along -= (along * normal).sum(axis=1, keepdims=True) * normal
    points, nodes = np.asarray(surface.points), 0.01 * key.normal(size=np.shape(surface.points))
    base, slope = load_and_slope(surface, points, nodes, np.asarray(places.points), along)

    def load(size):
        """The load in NumPy."""
        discs = on_host(SurfaceDiscs(np.asarray(places.points) + size * along, 6e-3, 1e-3))
        return discs.contact(on_host(moved(surface, points + size * nodes))).load

    np.testing.assert_allclose(base, load(0.0), atol=1e-12 * np.abs(base).max())
    errors = [float(np.abs(load(size) - base - size * slope).max()) for size in (2e-5, 1e-5)]
    assert errors[1] < 0.3 * errors[0] + 1e-9 * float(np.abs(base).max())
    assert errors[1] < 0.01 * 1e-5 * float(np.abs(slope).max())


def test_message_where_a_surface_is_no_bent_sheet():
    ball, sleeve, cone = (
        sphere(0.04, num_points=900),
        tube(0.03, 0.1, num_points=900),
        forearm(0.12, (0.03, 0.015), 0.04),
    )
    for mesh, place, exact in (
        (ball, [0.04, 0, 0], False),
        (sleeve, [0.03, 0, 0.05], True),
        (sleeve, [0.03, 0, 0.004], True),
        (cone, [0.02, 0.02, 0.06], False),
    ):
        at = Triangles.of(mesh).nearest([place]).points
        around = unfold(on_host(mesh), at, np.full((1, 1), 0.01))
        assert bool(around.exact[0]) is exact
        assert around.reached.sum() > 5


def test_contacts_do_not_cross_a_narrow_gap():
    """A sheet bent so far that its edges almost meet."""
    bent, plane, _, _ = bent_and_flat(0.0193, sheet=rectangle(0.12, 0.08, cell_size=4e-3))
    points = np.asarray(plane.points)
    at = np.abs(points - [0.057, 0.0]).sum(axis=1).argmin()
    place, far = np.asarray(bent.points)[at], points[:, 0] < 0
    assert np.linalg.norm(np.asarray(bent.points)[far] - place, axis=1).min() < 7e-3
    load = on_host(SurfaceDiscs(place[None], 8e-3, 1e-3)).contact(on_host(bent)).load
    exact = on_host(SheetDiscs(points[[at]], 8e-3, 1e-3)).contact(on_host(plane)).load
    np.testing.assert_allclose(load, exact, atol=1e-12 * exact.max())
    assert (load[far] == 0).all()
