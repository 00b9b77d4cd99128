"""Another toolkit's voltages, potentials, Jacobians and images on the same meshes.

The numbers are those of EIDORS 3.11; see the README beside them for conventions.
"""

from functools import cache
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.io
import scipy.sparse

from jeit.electrodes import BoundaryElectrodes, NodeElectrodes, electrodes_from_nodes
from jeit.forward import ForwardModel
from jeit.forward.exact import ConductingDisk, point_transfer_impedance
from jeit.inverse import Laplace, Noser, Tikhonov, one_step
from jeit.mesh import Mesh
from jeit.mesh.mesh import interior_facets
from jeit.protocol import from_channels

QUICK = ["circ2d_cem_576", "cyl3d_pem_768"]  # both electrode models in both dimensions; the others run in CI
SLOW = [
    "circ2d_pem_576",
    "circ2d_pem_576_opposite",
    "circ2d_cem_576_trig",
    "disk2d_cem_distmesh",
    "cyl3d_cem_netgen",
]
CASES = [*QUICK, *(pytest.param(case, marks=pytest.mark.slow) for case in SLOW)]
# Two direct solvers differ by the condition number, here 1e3 to 1e4, times rounding.
SOLVE = 1e-11


@cache
def load(path: Path) -> dict:
    """The arrays of one reference file as dense arrays; column vectors are flattened."""
    arrays = {}
    for key, value in scipy.io.loadmat(path, spmatrix=False).items():
        if not key.startswith("__"):
            dense = value.toarray() if scipy.sparse.issparse(value) else value
            arrays[key] = dense.ravel() if dense.ndim == 2 and dense.shape[1] == 1 else dense
    return arrays


@cache
def build(path: Path) -> tuple[dict, ForwardModel, list[np.ndarray]]:
    """The arrays of a case, the forward model on its mesh, and the nodes of its electrodes."""
    arrays = load(path)
    mesh = Mesh.create(arrays["nodes"], arrays["elems"].astype(int) - 1)
    table = arrays["elec_nodes"].reshape(arrays["stim"].shape[0], -1).astype(int)
    nodes = [row[row > 0] - 1 for row in table]
    if table.shape[1] == 1:
        electrodes = NodeElectrodes(table[:, 0] - 1)
    else:
        electrodes = electrodes_from_nodes(mesh, nodes, arrays["z_contact"])
    protocol = from_channels(arrays["stim"].T, arrays["meas"], arrays["meas_stim"].astype(int) - 1)
    return arrays, ForwardModel(mesh, electrodes, protocol), nodes


@pytest.fixture(params=CASES)
def reference(request, reference_folder):
    """Each case in turn: arrays, forward model, and nodes of the electrodes."""
    return build(reference_folder / f"{request.param}.mat")


def relative(value, expected) -> float:
    value, expected = np.asarray(value), np.asarray(expected)
    assert value.shape == expected.shape
    return float(np.abs(value - expected).max() / np.abs(expected).max())


@pytest.mark.parametrize(
    ("conductivity", "voltages"), [("sigma_h", "v_h"), ("sigma_i", "v_i"), ("sigma_complex", "v_complex")]
)
def test_voltages(reference, conductivity, voltages):
    arrays, model, _ = reference
    assert relative(model.voltages(arrays[conductivity]), arrays[voltages]) < SOLVE


def test_voltages_of_a_tensor(reference):
    """`v_tensor` holds the voltages of the tensor times `sigma_i`."""
    arrays, model, _ = reference
    tensors = arrays["sigma_i"][:, None, None] * arrays["tensor"]
    assert relative(model.voltages(tensors), arrays["v_tensor"]) < SOLVE


@pytest.mark.parametrize("case", ["circ2d_cem_576", pytest.param("disk2d_cem_distmesh", marks=pytest.mark.slow)])
def test_arcs_that_cover_whole_edges(reference_folder, case):
    """Arcs given by position and width equal the reference's electrodes exactly."""
    arrays, model, nodes = build(reference_folder / f"{case}.mat")
    facets, points = np.asarray(model.mesh.facets), np.asarray(model.mesh.points)
    position, width = [], []
    for members in nodes:
        edges = points[facets[np.isin(facets, members).all(axis=1)]]
        length = np.linalg.norm(edges[:, 1] - edges[:, 0], axis=1)
        if len(edges) == 2 and not np.array_equal(edges[0, 1], edges[1, 0]):
            edges, length = edges[::-1], length[::-1]
        path, stops = np.vstack([edges[:1, 0], edges[:, 1]]), np.append(0.0, np.cumsum(length))
        position.append([np.interp(stops[-1] / 2.0, stops, coordinate) for coordinate in path.T])
        width.append(length.sum())
    electrodes = BoundaryElectrodes(np.array(position), np.array(width), arrays["z_contact"])
    arcs = ForwardModel(model.mesh, electrodes, model.protocol)
    assert relative(arcs.voltages(arrays["sigma_h"]), arrays["v_h"]) < SOLVE


@pytest.mark.parametrize("state", ["h", "i"])
def test_potentials_of_nodes_and_electrodes(reference, state):
    arrays, model, _ = reference
    conductivity, ground = arrays[f"sigma_{state}"], int(arrays["gnd_node"].item()) - 1
    nodes = model.potentials(conductivity)
    electrodes = model.protocol.drive @ model.transfer_impedance(conductivity)
    # The reference grounds a node; the model's reference is the mean of the electrodes.
    earth = nodes[:, ground, None]
    assert relative((nodes - earth).T, arrays[f"u_{state}"]) < SOLVE
    assert relative((electrodes - earth).T, arrays[f"U_{state}"]) < SOLVE


@pytest.mark.parametrize("state", ["h", "i"])
def test_jacobian(reference, state):
    arrays, model, _ = reference
    assert relative(model.jacobian(arrays[f"sigma_{state}"]), arrays[f"J_{state}"]) < SOLVE


@pytest.mark.slow
def test_jacobian_of_electrodes_that_move_with_their_nodes(reference):
    """`J_movement_h`, all x then all y: each electrode moves the nodes that it covers, and the mesh with them.

    Both are compared by their products with one random vector.
    """
    arrays, model, nodes = reference
    owner = np.zeros((model.mesh.num_points, len(nodes)))
    for electrode, members in enumerate(nodes):
        owner[members, electrode] = 1.0

    def voltages(shift):
        points = model.mesh.points + owner @ shift
        return eqx.tree_at(lambda m: m.mesh.points, model, points).voltages(arrays["sigma_h"])

    way = np.random.default_rng(0).normal(size=(len(nodes), model.mesh.dimension))
    derivative = jax.jit(lambda way: jax.jvp(voltages, (jnp.zeros_like(way),), (way,))[1])(way)
    assert relative(derivative, arrays["J_movement_h"] @ way.T.ravel()) < SOLVE


def test_fields_solve_the_reference_system(reference):
    """Nodes first, then complete electrodes: matrix · (u, U) is the current that enters."""
    arrays, model, _ = reference
    nodes = np.asarray(model.potentials(arrays["sigma_h"]))
    drive = np.asarray(model.protocol.drive)
    if model.electrodes.is_point:
        current = np.zeros_like(nodes)
        current[:, np.asarray(model.electrodes.nodes)] = drive
        state = nodes
    else:
        current = np.hstack([np.zeros_like(nodes), drive])
        state = np.hstack([nodes, drive @ np.asarray(model.transfer_impedance(arrays["sigma_h"]))])
    assert relative(arrays["system_matrix_h"] @ state.T, current.T) < SOLVE


PRIORS = [(Laplace(), "laplace", 1e-9), (Tikhonov(), "tikhonov", 1e-9), (Noser(), "noser", 1e-7)]


@pytest.mark.parametrize(("prior", "name"), [(prior, name) for prior, name, _ in PRIORS])
def test_priors(reference, prior, name):
    arrays, model, _ = reference
    precision = prior.precision(model.mesh, model.jacobian(arrays["sigma_h"])).toarray()
    assert relative(precision, arrays[f"RtR_{name}"]) < 1e-12


def test_total_variation_rows(reference):
    """Every row is the measure of a shared face times (1, −1); the order and sign of the rows are arbitrary."""
    arrays, model, _ = reference
    pairs, shared = interior_facets(model.mesh)
    corners = np.asarray(model.mesh.points)[shared]
    edges = corners[:, 1:] - corners[:, :1]
    measure = np.sqrt(np.linalg.det(edges @ edges.transpose(0, 2, 1))) / edges.shape[1]
    rows = np.zeros((len(pairs), model.mesh.num_cells))
    rows[np.arange(len(pairs)), pairs[:, 0]] = measure
    rows[np.arange(len(pairs)), pairs[:, 1]] = -measure
    assert rows.shape == arrays["R_TV"].shape
    assert relative(rows.T @ rows, arrays["R_TV"].T @ arrays["R_TV"]) < 1e-13


@pytest.mark.parametrize(("prior", "name", "tolerance"), PRIORS)
def test_one_step_images(reference, prior, name, tolerance):
    arrays, model, _ = reference
    reconstruction = one_step(
        model, arrays["sigma_h"], prior=prior, hyperparameter=float(arrays["hyperparameter"].item())
    )
    assert relative(reconstruction.image(arrays["dv"]), arrays[f"x_{name}"]) < tolerance


def test_absolute_image_by_gauss_newton(reference):
    """The minimiser of ½‖v(σ) − v‖² + ½λ²‖σ − 1‖², by plain Gauss-Newton steps with the model's Jacobian."""
    arrays, model, _ = reference
    if "sigma_abs_gn_tikhonov" not in arrays:
        pytest.skip("the reference has no absolute image of this case")
    weight = float(arrays["hyperparameter_abs"].item()) ** 2
    conductivity = np.ones(model.mesh.num_cells)
    for _ in range(30):
        voltages, jacobian = map(np.asarray, model.voltages_and_jacobian(conductivity))
        gradient = jacobian.T @ (voltages - arrays["v_i"]) + weight * (conductivity - 1.0)
        # Data space, because M channels are fewer than m cells.
        gram = jacobian @ jacobian.T + weight * np.eye(len(voltages))
        step = (gradient - jacobian.T @ np.linalg.solve(gram, jacobian @ gradient)) / weight
        conductivity = conductivity - step
        if np.abs(step).max() < 1e-9:
            break
    assert relative(conductivity, arrays["sigma_abs_gn_tikhonov"]) < 1e-6


def test_disk_between_two_points_of_its_rim(reference_folder):
    """`analytic2d`: its homogeneous column is the Fourier series of the logarithm here, truncated at 512 points.

    Its potentials have a factor of 2π, because its current is given per unit angle over 2π. The truncated series
    converges to the logarithm like 1/(256 distance)². The concentric inclusion of its second column adds a smooth
    series that is not affected by the truncation.
    """
    arrays = load(reference_folder / "analytic2d.mat")
    angles = 2.0 * np.pi * np.arange(512) / 512
    poles = np.flatnonzero(arrays["I"])
    current = arrays["I"][poles] / 512
    away = np.array([np.abs((np.arange(512) - pole + 256) % 512 - 256) > 40 for pole in poles]).all(axis=0)
    concentric = ConductingDisk(1.0, 1.0, 0.5, 2.0)
    ours = point_transfer_impedance(ConductingDisk(), angles)[:, poles] @ current * 2.0 * np.pi
    assert relative(ours[away], arrays["V"][away, 0]) < 1e-4
    effect = concentric.inclusion_kernel(angles[:, None] - angles[poles]) @ current * 2.0 * np.pi
    assert relative(effect, arrays["V"][:, 1] - arrays["V"][:, 0]) < 1e-12
