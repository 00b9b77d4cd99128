"""Base classes of electrodes, and the contact integrals that the forward model uses."""

import abc
from typing import Any, Protocol

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int
from numpy.typing import ArrayLike

from jeit.arguments.checks import real_array
from jeit.mesh import Body, Mesh, Refine
from jeit_solvers.engines import as_array, has_values, namespace
from jeit_solvers.module import Module


class Contact(Module):
    """Contact integrals of a set of L electrodes on a mesh, divided by contact impedance.

    In the complete electrode model every electrode l adds the energy (1/z_l) ∫_l (u - U_l)². With P1 basis functions φ,
    the following integrals determine this energy:

    - `mass` (q, k, k), in siemens: Σ_l (1/z_l) ∫ φ_i φ_j over the q facets or cells, with k nodes each, that electrodes
      may touch, and `nodes` (q, k): nodes of these facets or cells; there is one pair of arrays `mass` and `nodes` for
      each kind of electrode;
    - `load` (n, L), in siemens: (1/z_l) ∫ φ_i, with column sums |e_l| / z_l, |e_l| being the size of the electrode.

    Point electrodes have no contact energy: `load` contains φ_i at the electrode, dimensionless; `mass` is zero, and
    `nodes` only contains the node that the forward model grounds.
    """

    nodes: tuple[Int[Array, "q k"], ...]
    mass: tuple[Float[Array, "q k k"], ...]
    load: Float[Array, "n L"]


class ElectrodePen(Protocol):
    """Interface to draw electrodes as seen from above, with one stroke per electrode; `middle` (d,) is the electrode's
    centre. All lengths are in metres."""

    def lines(self, segments: list[np.ndarray], centre: np.ndarray) -> None:
        """Draw an electrode on the edge of a sheet, which covers the polylines `segments`, each (k, 2)."""

    def disc(self, centre: np.ndarray, radius: float) -> None:
        """Draw a disc."""

    def rectangle(self, centre: np.ndarray, width: float, height: float) -> None:
        """Draw a rectangle with sides along x and y."""

    def dot(self, centre: np.ndarray) -> None:
        """Draw an electrode that has no size, or whose shape is not visible from above."""


class AbstractElectrodes(Module):
    """Base class of all electrodes, which compute contact integrals on a mesh."""

    contact_impedance: eqx.AbstractVar[Float[Array, " L"]]
    """Contact impedances (L,), ohm·m² (ohm·m for arcs on the edge of a sheet). Raises `AttributeError` for point
    electrodes, which have none."""

    @property
    @abc.abstractmethod
    def is_point(self) -> bool:
        """Whether these are point electrodes, which have no contact."""

    @property
    @abc.abstractmethod
    def num_electrodes(self) -> int:
        """Number of electrodes L."""

    @abc.abstractmethod
    def contact_nodes(self, mesh: Mesh) -> tuple[Int[Array, "q k"], ...]:
        """Nodes of the facets or cells that electrodes may touch, as in `Contact.nodes`; the nodes depend on the mesh
        only."""

    @abc.abstractmethod
    def contact(self, mesh: Mesh) -> Contact:
        """Contact integrals on `mesh`, differentiable in every field of the electrodes and in `mesh.points`."""

    @abc.abstractmethod
    def check(self, mesh: Mesh) -> None:
        """Raise `ValueError` if the electrodes do not fit `mesh`. Traced values are not checked."""

    @abc.abstractmethod
    def with_contact_impedance(self, contact_impedance: ArrayLike) -> "AbstractElectrodes":
        """Copy of the electrodes with new contact impedances, one number or (L,), ohm·m² (ohm·m for arcs).

        Raises `ValueError` for point electrodes, which have no contact impedance.
        """

    @abc.abstractmethod
    def geometry(self) -> dict[str, Any]:
        """Positions and sizes of the electrodes in metres, by the names of the fields."""

    @abc.abstractmethod
    def draw(self, mesh: Mesh, pen: ElectrodePen) -> None:
        """Draw the electrodes on `mesh` in order, as seen from above, with one stroke each."""

    @abc.abstractmethod
    def refinement(self, body: Body) -> tuple[Refine, ...]:
        """Refinements of a plane mesh at the electrodes; empty if the electrodes request none."""

    def describe(self) -> dict[str, Any]:
        """Kind, number, positions and sizes of the electrodes; lengths in metres."""
        return {"kind": type(self).__name__, "number": self.num_electrodes, **self.geometry(), "unit": "m"}


class AbstractCompleteElectrodes(AbstractElectrodes):
    """Base class of complete electrodes, each of which has a size and a contact impedance."""

    @property
    def is_point(self) -> bool:
        """False: complete electrodes have a size."""
        return False

    @property
    def num_electrodes(self) -> int:
        """Number of electrodes L."""
        return self.contact_impedance.shape[0]


class AbstractPlacedElectrodes(AbstractCompleteElectrodes):
    """Base class of complete electrodes whose positions are independent of the nodes of the mesh."""

    position: eqx.AbstractVar[Float[Array, "L d"]]

    def with_contact_impedance(self, contact_impedance: ArrayLike) -> AbstractCompleteElectrodes:
        """Copy of the electrodes with new contact impedances, ohm·m² (ohm·m for arcs). Raises `ValueError` for values
        that are not positive."""
        return replace_contact_impedance(self, contact_impedance)


class AbstractMovableElectrodes(AbstractPlacedElectrodes):
    """Base class of complete electrodes that can slide on a mesh."""

    @abc.abstractmethod
    def directions(self, mesh: Mesh) -> Float[np.ndarray, "L a d"]:
        """Unit vectors (L, a, d) along the a directions in which each electrode can move on `mesh`."""


class AbstractPointElectrodes(AbstractElectrodes):
    """Base class of point electrodes, which have no contact impedance."""

    @property
    def is_point(self) -> bool:
        """True: point electrodes have no size."""
        return True

    @property
    def contact_impedance(self) -> Float[Array, " L"]:  # pyright: ignore[reportIncompatibleVariableOverride]
        """Raises `AttributeError`: point electrodes have no contact impedance."""
        raise AttributeError(f"{type(self).__name__} have no contact impedance.")

    def with_contact_impedance(self, contact_impedance: ArrayLike) -> AbstractElectrodes:
        """Raises `ValueError`: point electrodes have no contact impedance."""
        raise ValueError(f"{type(self).__name__} have no contact impedance.")

    def contact_nodes(self, mesh: Mesh) -> tuple[Int[Array, "q k"], ...]:
        """Node 0, where the potential is grounded; point electrodes have no contact mass."""
        return (namespace(mesh).zeros((1, 1), mesh.cells.dtype),)


def replace_contact_impedance(
    electrodes: AbstractCompleteElectrodes, contact_impedance: ArrayLike
) -> AbstractCompleteElectrodes:
    """Copy electrodes with a new `contact_impedance`, one number or (L,). Raises `ValueError` for values that are not
    positive."""
    impedances = as_electrode_values("contact_impedance", contact_impedance, electrodes.num_electrodes, unit="ohm·m²")
    return eqx.tree_at(lambda complete_electrodes: complete_electrodes.contact_impedance, electrodes, impedances)


def as_electrode_values(name: str, values, num_electrodes: int, *, unit: str) -> Float[Array, " L"]:
    """Broadcast a positive number or array (L,) to floats (L,). Raises `ValueError` for a different shape, and for
    values that are not positive."""
    if has_values(values):
        values = real_array(
            name, values, f"one number for all electrodes or one for each of the {num_electrodes}, in {unit}"
        )
    values = as_array(values, float)
    if values.ndim > 1 or (values.ndim == 1 and values.shape[0] != num_electrodes):
        raise ValueError(
            f"{name} has shape {values.shape}; give one number for all electrodes or one for each of the "
            f"{num_electrodes}, in {unit}."
        )
    if not has_values(values):
        return jnp.broadcast_to(values, (num_electrodes,))
    is_invalid_value = ~(np.isfinite(values) & (np.asarray(values) > 0))
    if is_invalid_value.any():
        first_invalid_index = int(np.flatnonzero(np.atleast_1d(is_invalid_value))[0])
        raise ValueError(
            f"{name} must be positive and finite, in {unit}; electrode {first_invalid_index + 1} has "
            f"{float(np.atleast_1d(values)[first_invalid_index])}."
        )
    return as_array(np.broadcast_to(values, (num_electrodes,)))


def as_positions(position, dimensions: tuple[int, ...]) -> Float[Array, "L d"]:
    """Check and convert electrode positions (L, d) in metres; `dimensions` contains the allowed numbers d of
    coordinates. Raises `ValueError` for other shapes, NaN and infinity."""
    position = as_array(position, float)
    if position.ndim != 2 or position.shape[1] not in dimensions or position.shape[0] == 0:
        allowed_shapes = " or ".join(f"(L, {dimension})" for dimension in dimensions)
        raise ValueError(
            f"position has shape {position.shape}; give one row per electrode, {allowed_shapes}, in metres."
        )
    if has_values(position) and not np.isfinite(position).all():
        nonfinite_rows = np.flatnonzero(~np.isfinite(position).all(axis=1)) + 1
        raise ValueError(f"position has NaN or infinite coordinates at electrodes {nonfinite_rows.tolist()}.")
    return position


def check_dimension(electrodes: str, mesh: Mesh, dimension: int) -> None:
    """Raise `ValueError` for a surface in space, and for a mesh whose dimension is not `dimension`."""
    if mesh.is_surface:
        raise ValueError(
            f"{electrodes} do not live on a surface in space; PointElectrodes and NodeElectrodes do, plates along its "
            "edges, and FaceDiscs and FacePatches on a shell of it (jeit.mesh.shell)."
        )
    if mesh.dimension != dimension:
        raise ValueError(
            f"{electrodes} live on a {dimension}-D mesh, and this mesh is {mesh.dimension}-D; "
            "see 'How to choose electrodes' in the documentation for the kinds that fit."
        )
