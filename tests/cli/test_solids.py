"""A tank described as a solid and one on the user's own mesh, from a table of numbers to a picture."""

import json

import numpy as np
import pytest

from jeit.data import load_description
from jeit.mesh import Disk, centroids, write

PROTOCOL = """
[protocol]
kind = "adjacent"
current = 1e-3
"""
BODIES = {
    "solid": """
[geometry]
shape = "cylinder"
radius = 0.05
height = 0.04
[electrodes]
kind = "disc"
layout = "ring"
number = 8
levels = [0.02]
radius = 0.006
contact_impedance = 1e-3
""",
    "mesh": f"""
[geometry]
mesh = "tank.vtu"
[electrodes]
kind = "point"
positions = {[[0.049 * float(f(k)) for f in (np.cos, np.sin)] for k in np.arange(8) * np.pi / 4]}
""",
}


NODES = {"solid": {"num_points": 1500}, "mesh": {}}
# The search for bodies in solids is tested in tests/imaging.
OPTIONS = {"solid": ["--num-points", 600, "--method", "one-step"], "mesh": ["--segment"]}


def check_segments_of_outlines(folder, report, side):
    """The bodies found by outlines are those listed and those of the saved labels."""
    assert report["reconstruction"]["method"] == "gauss-newton"
    bodies = report["shapes"]["bodies"]
    assert len(bodies) == len(report["inclusions"]) > 0
    for body, listed in zip(bodies, report["inclusions"], strict=True):
        assert body["centroid"] == listed["centroid"]
        assert (body["conductivity_over_background"] > 1) == (listed["sign"] > 0)
    with np.load(folder / "image.npz") as content:
        labelled = (content["labels"] > 0).sum() * (side / 256) ** 2
    assert labelled == pytest.approx(sum(body["area"] for body in bodies), rel=0.1)


@pytest.mark.parametrize("body", BODIES)
def test_from_description_to_picture(body, run, tmp_path):
    write(Disk(0.05).mesh(num_points=250), tmp_path / "tank.vtu")
    (tmp_path / "full.toml").write_text(BODIES[body] + PROTOCOL)
    model = load_description(tmp_path / "full.toml").model(tmp_path / "full.csv", **NODES[body])
    where = np.asarray(centroids(model.mesh)) - np.array([0.02, 0.0, 0.02])[: model.mesh.dimension]
    for name, change in (("empty", 1.0), ("full", 3.0)):
        conductivity = np.where(np.linalg.norm(where, axis=1) < 0.012, change, 1.0)
        np.savetxt(tmp_path / f"{name}.csv", np.asarray(model.voltages(conductivity))[None], delimiter=",")
    status, printed, error = run(
        "reconstruct", tmp_path / "full.csv", "--reference", tmp_path / "empty.csv",
        "--description", tmp_path / "full.toml", "--output", tmp_path / "out",
        *OPTIONS[body],
    )  # fmt: skip
    assert (status, error) == (0, "")
    assert ("volume" in printed) == (body == "solid")
    assert (" area " in printed) == ("/ mm²" in printed) == (body == "mesh")  # the heading may take two lines
    assert ("outline" in printed) == (body == "mesh")
    assert ("peak change" if body == "solid" else "68 % interval") in printed
    assert ("only fitted bodies have intervals" in printed) == (body == "solid")
    assert ("of back-" if body == "solid" else "strength") in printed
    assert (tmp_path / "out" / "image.png").stat().st_size > 10_000
    report = json.loads((tmp_path / "out" / "report.json").read_text())
    (found,) = report["inclusions"]
    assert found["kind"] == "conductive"
    size = {"volume", "volume_unit"} if body == "solid" else {"area", "area_unit", "area_interval"}
    assert {key for key in found if key.startswith(("area", "volume"))} == size
    assert ("centroid_radius" in found) == (body == "mesh")
    assert found.get("volume_unit", found.get("area_unit")) == ("m³" if body == "solid" else "m²")
    assert (tmp_path / "out" / "image.vtu").is_file() == (body == "solid")
    assert ("image.vtu" in printed) == (body == "solid")
    np.testing.assert_allclose(found["centroid"], [0.02, 0.0, 0.02][: model.mesh.dimension], atol=0.005)
    if body == "solid":
        assert report["geometry"]["thickness"] == 0.04
    else:
        assert report["geometry"]["mesh"]["points"] == model.mesh.num_points
        check_segments_of_outlines(tmp_path / "out", report, side=0.1)


@pytest.mark.parametrize("command", [["reconstruct"], ["stream"], ["choose"]])
def test_number_of_nodes_is_refused_for_a_given_mesh(command, run, tmp_path):
    write(Disk(0.05).mesh(num_points=250), tmp_path / "tank.vtu")
    (tmp_path / "full.toml").write_text(BODIES["mesh"] + PROTOCOL)
    model = load_description(tmp_path / "full.toml").model(tmp_path / "full.csv")
    np.savetxt(tmp_path / "full.csv", np.asarray(model.voltages(1.0))[None], delimiter=",")
    status, _, error = run(
        *command, tmp_path / "full.csv", "--reference", tmp_path / "full.csv", "--description", tmp_path / "full.toml",
        "--output", tmp_path / "out", "--num-points", 1200,
    )  # fmt: skip
    assert status == 1
    nodes = model.mesh.num_points
    assert f"--num-points has no effect: the body is a mesh of your own, of {nodes} nodes" in " ".join(error.split())
    assert not (tmp_path / "out").exists()


def test_number_of_nodes_of_the_model(tmp_path):
    write(Disk(0.05).mesh(num_points=250), tmp_path / "tank.vtu")
    for body, number, message in (("mesh", 250, "num_points has no effect"), ("solid", None, "num_points is missing")):
        (tmp_path / "tank.toml").write_text(BODIES[body] + PROTOCOL)
        with pytest.raises(ValueError, match=message):
            load_description(tmp_path / "tank.toml").model("full.csv", num_points=number)


SOLIDS = {
    "box, width 100 mm, depth 80 mm, height 60 mm": "shape = 'box'\nwidth = 0.1\ndepth = 0.08\nheight = 0.06",
    "cylinder, radius 50 mm, height 40 mm": "shape = 'cylinder'\nradius = 0.05\nheight = 0.04",
    "rectangle, width 100 mm, height 80 mm": "shape = 'rectangle'\nwidth = 0.1\nheight = 0.08",
    "polygon, thickness 10 mm": "shape = 'polygon'\nvertices = [[0, 0], [1, 0], [0, 1]]\nthickness = 0.01",
}


@pytest.mark.parametrize("printed", SOLIDS)
def test_info_describes_a_body_in_the_words_of_its_description(printed, run, tmp_path):
    (tmp_path / "full.toml").write_text(f"[geometry]\n{SOLIDS[printed]}\n{PROTOCOL}number = 8\n")
    np.savetxt(tmp_path / "full.csv", np.arange(1.0, 41)[None], delimiter=",")
    status, out, error = run("info", tmp_path / "full.csv")
    assert (status, error) == (0, "")
    assert f" {printed} " in " ".join(out.split()) + " "
