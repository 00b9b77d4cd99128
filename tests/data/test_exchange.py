"""Models of other toolkits: their voltages on their own meshes."""

from types import SimpleNamespace

import numpy as np
import pytest
import scipy.io
import scipy.sparse

from jeit.data import from_eidors, from_pyeit
from jeit.electrodes import NodeElectrodes
from jeit.forward import ForwardModel
from jeit.mesh import Disk, Mesh
from jeit.protocol import adjacent, opposite

SOLVE = 1e-11


def as_struct(arrays):
    """An EIDORS `fwd_model` from the arrays of a reference file."""
    drives = np.ravel(arrays["meas_stim"]).astype(int)
    places = arrays["elec_nodes"].astype(int)
    impedances = np.ravel(arrays.get("z_contact", np.full(len(places), 0.01)))
    electrode = [{"nodes": row[row > 0], "z_contact": float(z)} for row, z in zip(places, impedances, strict=True)]
    stim, meas = (scipy.sparse.csc_matrix(arrays[name]).toarray() for name in ("stim", "meas"))
    sparse = scipy.sparse.csc_matrix
    stimulation = [
        {"stim_pattern": sparse(stim[:, [k]]), "meas_pattern": sparse(meas[drives == k + 1])}
        for k in range(stim.shape[1])
    ]
    return {"nodes": arrays["nodes"], "elems": arrays["elems"], "electrode": electrode, "stimulation": stimulation}


@pytest.mark.parametrize("case", ["circ2d_pem_576", "circ2d_cem_576", "circ2d_cem_576_trig", "cyl3d_cem_netgen"])
def test_voltages_of_an_eidors_model(case, reference_folder, tmp_path):
    arrays = scipy.io.loadmat(reference_folder / f"{case}.mat", spmatrix=False)
    scipy.io.savemat(tmp_path / "a.mat", {"img": {"fwd_model": as_struct(arrays), "name": case}, "v": arrays["v_i"]})
    model = from_eidors(tmp_path / "a.mat")
    found, expected = np.asarray(model.voltages(np.ravel(arrays["sigma_i"]))), np.ravel(arrays["v_i"])
    assert np.abs(found - expected).max() < SOLVE * np.abs(expected).max()


def test_files_without_a_model(tmp_path):
    scipy.io.savemat(tmp_path / "a.mat", {"x": 1.0})
    with pytest.raises(ValueError, match=r"variable: a\.mat has no model; save a fwd_model"):
        from_eidors(tmp_path / "a.mat")
    (tmp_path / "b.mat").write_bytes(b"nothing")
    with pytest.raises(ValueError, match=r"b\.mat is not a readable \.mat file"):
        from_eidors(tmp_path / "b.mat")


@pytest.mark.parametrize("made", [adjacent, opposite])
def test_a_pyeit_model(made):
    """Its protocol lists pairs for each drive, and nodes of a plane mesh have a z coordinate."""
    mesh = Disk(1.0).mesh(num_points=200)
    points = np.asarray(mesh.points)
    rim = np.flatnonzero(np.isclose(np.linalg.norm(points, axis=1), 1))
    nodes = rim[np.argsort(np.arctan2(*points[rim].T[::-1]))][:: len(rim) // 8][:8]
    protocol = made(8, current=1.0)
    expected = ForwardModel(mesh, NodeElectrodes(nodes), protocol).voltages(2.0)

    def pairs(patterns):
        return np.stack([patterns.argmax(axis=1), patterns.argmin(axis=1)], axis=1)

    drive, read = np.asarray(protocol.drive), np.asarray(protocol.channel_measurement)
    theirs = SimpleNamespace(
        node=np.column_stack([points, np.zeros(len(points))]), element=np.asarray(mesh.cells), el_pos=nodes
    )
    rows = pairs(read).reshape(protocol.num_drives, -1, 2)
    model = from_pyeit(theirs, SimpleNamespace(ex_mat=pairs(drive), meas_mat=rows))
    assert isinstance(model.mesh, Mesh)
    np.testing.assert_allclose(model.voltages(2.0), expected, rtol=1e-11)
    with pytest.raises(ValueError, match="protocol has no ex_mat; give the protocol that pyEIT made"):
        from_pyeit(theirs, None)
