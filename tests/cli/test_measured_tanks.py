"""Detection of bodies in the small tank and in the challenge's tank, with jeit's default settings."""

import csv
import functools
import re

import jax.numpy as jnp
import numpy as np
import pytest

from benchmarks.cases import ktc2023
from jeit.data import read
from jeit.image import Raster, find_inclusions
from jeit.imaging import ImagingSettings, image_difference
from jeit.imaging.preparation import prepare_difference
from jeit.inverse import Gaussian, reconstruct
from jeit.inverse.nonlinear import GaussNewton

PITCH = 22.5  # degrees between electrodes of the 6 cm tank


def named_rods(folder_name):
    """(electrode from 1, sign) of every rod, from the folder's name."""
    rods = re.findall(r"electrode(\d+)_(metal|plastic)", folder_name)
    return [(int(number), 1 if kind == "metal" else -1) for number, kind in rods]


def electrode_angle(number):
    return 90 - PITCH * (number - 1)


@pytest.mark.slow
def test_tank6cm_every_rod_beside_its_electrode(data_folder):
    files = [file for file in sorted((data_folder / "tank6cm").glob("electrode*/*.csv")) if "20uA" not in file.name]
    assert len(files) == 5
    for file in files:
        result = image_difference(read(file))
        for number, sign in named_rods(file.parent.name):
            angles = [
                abs((np.degrees(np.arctan2(i.centroid[1], i.centroid[0])) - electrode_angle(number) + 180) % 360 - 180)
                for i in result.inclusions
                if i.sign == sign
            ]
            assert angles, f"{file.parent.name}: no inclusion of sign {sign}"
            assert min(angles) < 12, f"{file.parent.name}: electrode {number}, {min(angles):.1f}° off"


def test_tank6cm_frames_of_weak_current_are_refused(data_folder, run, tmp_path):
    (file,) = (data_folder / "tank6cm").glob("*/*20uA*.csv")
    status, _, error = run("reconstruct", file, "--output", tmp_path)
    assert status == 1
    assert "too noisy" in error
    assert error.count("\n") == 1
    status, output, _ = run("info", file)
    assert status == 0
    assert "so many impossible signs are those of noise" in " ".join(output.split())


KIT4_RADIUS = 0.14


def kit4_truth(folder):
    """Sign and position in metres of every inclusion, by the name of its file."""
    truth: dict[str, list[tuple[int, np.ndarray]]] = {}
    with open(folder / "truth_centroids.csv", newline="") as file:
        for row in csv.DictReader(file):
            place = KIT4_RADIUS * np.array([float(row["x_over_R"]), float(row["y_over_R"])])
            truth.setdefault(row["case"], []).append((1 if row["kind"] == "conductive" else -1, place))
    return truth


def matched(case, found, inclusions):
    """Distance, relative to the radius, to the nearest detected inclusion of the same sign; each is matched once."""
    errors, left = [], list(found)
    for sign, place in inclusions:
        distances = {i: np.hypot(*(one.centroid - place)) for i, one in enumerate(left) if one.sign == sign}
        assert distances, f"{case}: an inclusion of sign {sign} is missing"
        nearest = min(distances, key=distances.__getitem__)
        errors.append(distances[nearest] / KIT4_RADIUS)
        del left[nearest]
    return errors


@pytest.mark.slow(first=True)
def test_kit4_every_inclusion_with_its_sign(data_folder):
    """All 34 inclusions of the 17 files with one setting; each is matched with the nearest detected one of its sign."""
    folder = data_folder / "kit4"
    truth = kit4_truth(folder)
    assert sum(map(len, truth.values())) == 34
    reference = read(folder / "datamat_1_0.mat")
    errors = []
    for case, inclusions in truth.items():
        found = list(image_difference(read(folder / f"datamat_{case}.mat"), reference).inclusions)
        assert len(found) == len(inclusions), f"{case}: {len(found)} inclusions found, {len(inclusions)} are there"
        errors += matched(case, found, inclusions)
    assert max(errors) <= 0.10
    # It was 0.037 with every mesh and setting tried. Half of it is a shift of 0.018 R common to all inclusions, within
    # the ±0.03 R of the published centroids.
    assert np.median(errors) <= 0.04


# Correlation of the image on a logarithmic scale with the truth (water 0, resistive -1, conductive +1) over all pixels
# of the tank, and the number of bodies. Default settings with a 2-D model of 8 % misfit: the values reached, less a
# margin of 0.05 for other meshes and machines.
LEAST_CORRELATION = {1: (0.84, 2), 2: (0.84, 2), 3: (0.84, 1), 4: (0.71, 1)}


@pytest.fixture(scope="module")
def challenge(data_folder):
    """A function that images a target of the challenge at a level, each once, with the settings of its score."""
    return functools.cache(
        lambda target, level: ktc2023.imaged(data_folder / "ktc2023", target, level, ImagingSettings(segment=True))
    )


@pytest.mark.slow
@pytest.mark.parametrize("number", LEAST_CORRELATION)
def test_ktc2023_images_correlate_with_the_truth(number, data_folder, challenge):
    """Images with bodies: without, those that are segmented are of total variation (test_automatic.py)."""
    import scipy.io

    folder = data_folder / "ktc2023"
    result = challenge(number, 1)
    assert result.shapes is not None
    label = scipy.io.loadmat(folder / f"true{number}.mat")["truth"]
    truth = np.select([label == 1, label == 2], [-1.0, 1.0], 0.0)
    raster = np.asarray(Raster.create(result.mesh, extent=(-0.115, 0.115, -0.115, 0.115)).sample(result.departure))
    inside = np.isfinite(raster)
    correlation = np.corrcoef(raster[inside], truth[inside])[0, 1]
    least, bodies = LEAST_CORRELATION[number]
    assert correlation > least
    assert len(result.inclusions) == bodies


@pytest.mark.slow
def test_kit4_gauss_newton_converges_on_every_file(data_folder):
    """With the command's settings. One calibration serves all files, which share their reference."""
    folder = data_folder / "kit4"
    truth = kit4_truth(folder)
    reference = read(folder / "datamat_1_0.mat")
    prepared = prepare_difference(read(folder / "datamat_1_1.mat"), reference, num_points=1500)
    model, background = prepared.model, prepared.calibration.conductivity
    errors = []
    for case, inclusions in truth.items():
        difference = read(folder / f"datamat_{case}.mat").filled()[0] - reference.filled()[0]
        result = reconstruct(
            model, model.voltages(background) + difference, background, prior=Gaussian(0.085 * 2 * KIT4_RADIUS),
            hyperparameter=5.0, noise=prepared.relative_noise, mask=prepared.mask, solver=GaussNewton(rtol=1e-4),
        )  # fmt: skip
        assert result.status == "converged"
        assert result.iterations <= 10
        found = find_inclusions(model.mesh, jnp.log(result.conductivity / background), level=0.65, least_peak=0.3)
        assert len(found) == len(inclusions)
        errors += matched(case, found, inclusions)
    assert max(errors) <= 0.105
    assert np.median(errors) <= 0.031


@pytest.mark.slow
def test_ktc2023_segmentation(data_folder, challenge):
    """The challenge's training targets with all electrodes and with 12 of 32 removed. The scores on the default mesh
    are 0.95 and 0.88.

    The requirement is a mean of 0.8 over all levels, and of 0.7 from the fourth on.
    """
    folder, targets = data_folder / "ktc2023", ktc2023.TARGETS
    whole, hardest = (
        np.mean([ktc2023.score(challenge(target, level), folder, target) for target in targets]) for level in (1, 7)
    )
    assert whole >= 0.92
    assert hardest >= 0.82
