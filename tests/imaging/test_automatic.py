"""The default method: a linear image where that is sound, otherwise a nonlinear reconstruction, and what it detects."""

import dataclasses
import functools
from contextlib import nullcontext
from dataclasses import replace

import numpy as np
import pytest

from benchmarks.problems.mixed_tanks import draw, matched
from jeit import image_difference
from jeit.data import Measurement
from jeit.electrodes import BoundaryElectrodes
from jeit.forward import ForwardModel
from jeit.image import find_inclusions
from jeit.imaging import ImagingSettings, automatic, calibration, compare_on_data, difference, prepare_difference
from jeit.imaging.automatic import linear_image_fault
from jeit.imaging.method import METHODS
from jeit.inverse import Gaussian, calibrate, reconstruct
from jeit.inverse.uncertainty import image_noise
from jeit.layout import ring
from jeit.mesh import Disk, centroids
from jeit.protocol import adjacent
from jeit.report.image import report_image

RADIUS = 0.05
TRUTH = ForwardModel(Disk(RADIUS).mesh(num_points=2000), BoundaryElectrodes(ring(RADIUS, 16), 0.01, 0.05), adjacent(16))
CENTRES = np.asarray(centroids(TRUTH.mesh))
FEW = {"num_points": 450, "raster_shape": (128, 128)}


@functools.cache
def frame(factor: float = 1.0, *, noise: float = 1e-4, seed: int = 0) -> Measurement:
    """A disk of a third of the tank's radius, whose conductivity is `factor` times that of the rest."""
    inside = np.linalg.norm(CENTRES - [0.02, 0.01], axis=1) < RADIUS / 3
    voltages = np.asarray(TRUTH.voltages(np.where(inside, 0.02 * factor, 0.02)))
    voltages = voltages * (1 + noise * np.random.default_rng(seed).normal(size=voltages.shape))
    return Measurement(
        voltages,
        np.ones(voltages.shape, bool),
        TRUTH.protocol,
        electrodes=TRUTH.electrodes,
        domain=Disk(RADIUS),
        name=f"{factor}",
    )


@functools.cache
def image(factor: float, **settings):
    """The same settings are imaged once. No test changes the result."""
    return image_difference(frame(factor, seed=1), frame(), ImagingSettings(**{**FEW, **settings}))


def test_a_small_change_is_imaged_in_one_step():
    result = image(1.05)
    assert result.settings.method == "one-step"
    assert "sound" in result.why
    assert report_image(result)["reconstruction"]["why"] == result.why


def test_frames_are_imaged_with_one_blas_thread(monkeypatch):
    entered = []

    def context():
        entered.append(True)
        return nullcontext()

    for module in (calibration, difference):
        monkeypatch.setattr(module, "one_thread_of_blas", context)
    image(20.0, method="one-step", raster_shape=(16, 16))
    assert len(entered) == 2  # during calibration and during imaging


def test_a_sheet_has_no_columns():
    with pytest.raises(ValueError, match="bodies: ellipsoids and columns are of solids, and this is a sheet"):
        image(1.05, bodies="columns")


@pytest.mark.parametrize(("factor", "why"), [(20.0, "no longer linear"), (1e-3, "below -100 %")])
def test_a_strong_change_is_reconstructed_nonlinearly(factor, why):
    result = image(factor)
    assert result.settings.method == "gauss-newton"
    assert why in result.why
    assert len(result.inclusions) == 1
    assert np.sign(np.log(factor)) == result.inclusions[0].sign
    assert np.linalg.norm(np.array(result.inclusions[0].centroid) - [0.02, 0.01]) < 0.04 * RADIUS


def test_strong_bodies_have_outlines():
    result = image(20.0)
    assert result.shapes is not None
    (star,) = result.shapes.bodies
    np.testing.assert_allclose(star.area, np.pi * RADIUS**2 / 9, rtol=0.15)
    assert result.inclusions[0].area == pytest.approx(star.area)
    reported = report_image(result)["shapes"]
    assert len(reported["bodies"]) == 1
    assert np.shape(reported["bodies"][0]["outline"]) == star.outline.shape
    (body,), (inclusion,) = reported["bodies"], report_image(result)["inclusions"]
    assert inclusion["contrast_interval"][0] < body["conductivity_over_background"] - 1
    assert inclusion["peak_relative_to_background"] == pytest.approx(body["conductivity_over_background"] - 1)
    labels = image(20.0, segment=True).labels
    share = (labels == 2).sum() / (labels.size * np.pi / 4)
    np.testing.assert_allclose(share, star.area / (np.pi * RADIUS**2), rtol=0.02)


def test_weak_bodies_are_segmented_from_an_image_of_few_components():
    result = image(1.05, segment=True)
    assert (result.settings.method, result.shapes) == ("total-variation", None)
    assert "bodies are weak" in result.why
    assert set(np.unique(result.labels)) == {0, 2}


def test_every_inclusion_of_a_segmented_image_is_labelled():
    """A body that shows a quarter of the contrast of another of its sign is also labelled."""
    near = [np.linalg.norm(CENTRES - place, axis=1) < 0.013 for place in ([0.028, 0], [-0.028, 0])]
    voltages = np.asarray(TRUTH.voltages(0.02 * np.where(near[0], 1.2, np.where(near[1], 1.09, 1.0))))
    one = frame()
    pair = Measurement(voltages, one.mask, one.protocol, electrodes=one.electrodes, domain=one.domain)
    plain, cut = (
        image_difference(pair, frame(noise=0), ImagingSettings(**FEW, method="total-variation", segment=segment))
        for segment in (False, True)
    )
    assert [one.sign for one in cut.inclusions] == [one.sign for one in plain.inclusions] == [1, 1]
    assert cut.inclusions[1].peak < 0.5 * cut.inclusions[0].peak
    pixel = np.prod([cut.extent[1] - cut.extent[0], cut.extent[3] - cut.extent[2]]) / cut.labels.size
    labelled = [(part == 2).sum() * pixel for part in np.array_split(cut.labels, 2, axis=1)]
    np.testing.assert_allclose(labelled, [one.area for one in cut.inclusions[::-1]], rtol=0.05)


def test_noise_damps_images_which_then_are_not_sound():
    """A body that a sound image shows at a fifth of its contrast: kept linear, unless noise is the reason."""
    pairs = (frame(1.15, seed=1), frame()), (frame(1.15, noise=1.5e-2, seed=2), frame())
    sound, noisy = (image_difference(*pair, ImagingSettings(**FEW, method="one-step")) for pair in pairs)
    shown = [float(np.abs(one.change).max() / one.calibration.conductivity) for one in (sound, noisy)]
    assert all(0.1 < one < 0.3 for one in shown)
    relative = [one.quality.difference_noise.relative for one in (sound, noisy)]
    assert relative[0] < 0.3 < relative[1]
    faults = [
        linear_image_fault(prepare_difference(*pair, num_points=450), one.change)
        for pair, one in zip(pairs, (sound, noisy), strict=True)
    ]
    assert faults[0] == ""
    assert "no longer linear" in faults[1]


def test_sharp_outlines_are_fitted_less_closely_where_the_model_is_wrong():
    exact = prepare_difference(frame(20.0, seed=1), frame(), num_points=450)
    noisy = prepare_difference(frame(20.0, noise=0.1, seed=1), frame(), num_points=450)
    for one in (exact, noisy):
        model = np.sqrt(np.asarray(one.modelled_noise) ** 2 - (one.noise * np.asarray(one.relative_noise)) ** 2)
        expected = np.hypot(one.noise * np.asarray(one.relative_noise), 3 * model)
        np.testing.assert_allclose(one.sharp_noise, expected, rtol=1e-6)
    assert noisy.modelled_share < 0.5 < 0.95 < exact.modelled_share < 1


def test_noise_that_is_not_known_is_estimated_from_what_an_image_leaves_unexplained():
    """So the smooth image has a misfit of at most 1, and bodies that only noise supports are not fitted."""
    known = prepare_difference(frame(20.0, seed=1), frame(), num_points=450)
    assert known.with_noise_from(5.0) is known
    unknown = replace(known, quality=replace(known.quality, trusted_noise=None))
    assert unknown.with_noise_from(0.9) is unknown
    scaled = unknown.with_noise_from(5.0)
    relative_noise = np.asarray(known.relative_noise)
    modelled, unexplained = (
        np.sqrt(np.mean((np.asarray(noise) / relative_noise) ** 2))
        for noise in (unknown.modelled_noise, scaled.noise * relative_noise)
    )
    assert unexplained == pytest.approx(5 * modelled)
    assert (np.asarray(scaled.sharp_noise) > 4.9 * np.asarray(unknown.modelled_noise)).all()


def test_shapes_can_be_requested():
    result = image(20.0, method="shapes")
    assert (result.settings.method, result.chosen_by) == ("shapes", "none")
    assert [one.sign for one in result.inclusions] == [1]
    report = report_image(result)
    assert report["reconstruction"]["prior"] == "star shapes"
    assert report["hyperparameter"]["value"] is None


def test_shapes_that_explain_less_than_the_image_are_not_shown(monkeypatch):
    found = image(20.0)
    assert found.shapes is not None
    most = max(1.0, 1.5 * float(found.reconstruction.misfit))
    for misfit, shown in ((0.99 * most, True), (1.01 * most, False)):
        shapes = replace(found.shapes, misfit=misfit)
        monkeypatch.setattr(automatic, "shapes_in", lambda *_, shapes=shapes: shapes)
        tried = image.__wrapped__(20.0)
        assert (tried.shapes is not None) == shown
        assert ("outlines fitted" if shown else "outlines of bodies miss the voltages by") in tried.why
    monkeypatch.setattr(automatic, "shapes_in", lambda *_: replace(found.shapes, bodies=()))
    assert "; no body's outline explains the voltages better" in image.__wrapped__(20.0).why


@pytest.mark.slow
def test_shapes_that_do_not_explain_the_voltages_are_not_shown():
    """Conductivity that rises evenly across the tank is not a body."""

    def sloped(amount, seed):
        rising = 0.02 * np.exp(amount * CENTRES[:, 0] / RADIUS)
        voltages = np.asarray(TRUTH.voltages(rising))
        voltages = voltages * (1 + 1e-4 * np.random.default_rng(seed).normal(size=voltages.shape))
        one = frame()
        return Measurement(voltages, one.mask, one.protocol, electrodes=one.electrodes, domain=one.domain)

    result = image_difference(sloped(1.2, 1), sloped(0.0, 0), ImagingSettings(num_points=700))
    assert result.settings.method == "gauss-newton"
    assert result.shapes is None


def test_a_requested_hyperparameter_or_method_is_used():
    assert ImagingSettings(hyperparameter="gcv").method == "one-step"
    assert ImagingSettings(method="gauss-newton", hyperparameter=3.0).method == "gauss-newton"
    result = image(20.0, method="one-step")
    assert (result.settings.method, result.why) == ("one-step", "")


def test_reasons_to_doubt_an_image_are_reported():
    """A λ so small that noise is imaged, and one so large that few of the data are."""
    assert image(20.0, method="gauss-newton").doubts == image(1.05).doubts == ()
    unfinished = image(20.0, method="gauss-newton", hyperparameter=1e-4).doubts
    assert "did not converge" in unfinished[0]
    stiff = image(20.0, method="gauss-newton", hyperparameter=1e3)
    assert "standard deviations: bodies may be missing" in stiff.doubts[-1]
    assert report_image(stiff)["doubts"] == list(stiff.doubts)


def test_a_strong_body_is_found_although_the_noise_equals_the_signal():
    noisy = [frame(factor, noise=0.2, seed=seed) for factor, seed in ((0.05, 4), (1.0, 5))]
    result = image_difference(*noisy, ImagingSettings(**FEW))
    (body,) = result.inclusions
    assert body.sign < 0
    np.testing.assert_allclose(body.centroid, [0.02, 0.01], atol=0.05 * RADIUS)
    assert "of the difference from the reference (apart from a common factor): bodies may be missed" in result.doubts[0]


def test_exchanged_files_are_doubted():
    """Of a tank whose reference contains a strong body."""
    assert image(20.0).doubts == ()
    exchanged = image_difference(frame(), frame(20.0, seed=1), ImagingSettings(method="one-step", **FEW))
    assert any("are the two exchanged?" in doubt for doubt in exchanged.doubts)


def test_lengths_in_another_unit_are_doubted():
    """Of a tank that is described a hundred times too large."""

    def enlarged(measurement):
        electrodes = BoundaryElectrodes(ring(100 * RADIUS, 16), 0.009, 0.05)
        return dataclasses.replace(measurement, electrodes=electrodes, domain=Disk(100 * RADIUS))

    large = [enlarged(measurement) for measurement in (frame(1.05, seed=1), frame())]
    result = image_difference(*large, ImagingSettings(method="one-step", hyperparameter=1.0, **FEW))
    assert any("are all lengths in metres?" in doubt for doubt in result.doubts)


def test_one_step_is_kept_where_gauss_newton_fails(monkeypatch):
    def fails(*_):
        raise ValueError("it fails.")

    monkeypatch.setitem(METHODS, "gauss-newton", METHODS["gauss-newton"].__class__(fails, takes_prior=True))
    result = image.__wrapped__(20.0)
    assert result.settings.method == "one-step"
    assert "Gauss-Newton found no image. it fails." in result.why


@pytest.mark.slow
def test_the_noise_of_an_image_is_the_scatter_of_images():
    """Repeated frames of a small change: images scatter as predicted from one of them."""
    electrodes = BoundaryElectrodes(ring(RADIUS, 8), 0.01, 0.05)
    model = ForwardModel(Disk(RADIUS).mesh(num_points=120), electrodes, adjacent(8))
    clean, rng = np.asarray(model.voltages(0.02)), np.random.default_rng(0)
    noise = 0.01 * np.abs(clean)
    found = [
        reconstruct(
            model,
            clean + noise * rng.normal(size=clean.shape),
            0.02,
            prior=Gaussian(0.01),
            hyperparameter=5.0,
            noise=noise,
        )
        for _ in range(60)
    ]
    scatter = np.std([np.log(np.asarray(one.conductivity)) for one in found], axis=0)
    # For 60 frames the deviation is uncertain by 9 %, and misfits are between 0.8 and 1.2.
    np.testing.assert_allclose(np.median(scatter / image_noise(found[0])), 1.0, atol=0.15)


def test_artefacts_of_noise_are_not_listed():
    mesh = Disk(RADIUS).mesh(num_points=400)
    away = [np.linalg.norm(np.asarray(centroids(mesh)) - place, axis=1) for place in ([0.02, 0], [-0.02, 0])]
    shown = np.exp(-((away[0] / 0.01) ** 2)) + 0.5 * np.exp(-((away[1] / 0.01) ** 2))
    assert len(find_inclusions(mesh, shown)) == 2
    assert len(find_inclusions(mesh, shown, noise=np.full(len(shown), 0.1))) == 1
    assert len(find_inclusions(mesh, shown, noise=np.full(len(shown), 0.08))) == 2
    with pytest.raises(ValueError, match="noise"):
        find_inclusions(mesh, shown, noise=np.ones(3))


def test_noise_without_reciprocal_channels_is_listed_neither_by_an_image_nor_by_the_rules_for_its_hyperparameter():
    pairs, _ = TRUTH.protocol.reciprocal_pairs()
    usable = np.ones(TRUTH.protocol.num_measurements, bool)
    usable[np.asarray(pairs)[:, 1]] = False
    noise, rest = (frame(noise=0.1, seed=seed).masked(usable, "half") for seed in (3, 4))
    result = image_difference(noise, rest, ImagingSettings("one-step", **FEW))
    outcome = compare_on_data(noise, rest, ImagingSettings(**FEW), rules=["noise-figure"])
    assert len(find_inclusions(result.mesh, result.change)) > 5
    assert result.inclusions == outcome.outcomes["noise-figure"].inclusions == ()
    for doubts in (result.doubts, outcome.prepared.doubts):
        assert any("leaves unexplained" in doubt for doubt in doubts)


def test_model_errors_are_noise_to_nonlinear_solvers():
    """Channels with different gains: the model misfits the reference and the difference by the same ratio."""
    gain = 1 + 0.05 * np.random.default_rng(0).normal(size=frame().num_channels)

    def uneven(one: Measurement) -> Measurement:
        return replace(one, voltages=one.voltages * gain)

    prepared = prepare_difference(uneven(frame(20.0)), uneven(frame()), num_points=700, as_is=True)
    exact = prepare_difference(frame(20.0, seed=1), frame(), num_points=700)
    assert float(prepared.calibration.misfit) > 3 * float(exact.calibration.misfit)
    for one in (prepared, exact):
        measured = np.asarray(one.reference.voltages)[0]
        off, noise = np.asarray(one.calibration.voltages) - measured, np.asarray(one.relative_noise)
        shares = [np.linalg.norm(off / scale) / np.linalg.norm(measured / scale) for scale in (1.0, noise)]
        missed = max(0.03, min(shares))
        size = np.sqrt(np.mean((one.difference / one.relative_noise) ** 2))
        np.testing.assert_allclose(one.modelled_noise, one.relative_noise * np.hypot(one.noise, missed * size))
    # Noise of 1e-4 of each voltage, in both frames. Channels have an assumed error of 1e-2.
    assert 0.008 < exact.noise < 0.02


@pytest.mark.slow
@pytest.mark.parametrize("seed", [2, 6, 31])
def test_metal_and_plastic_in_one_tank_are_all_detected_and_nothing_else(seed):
    tank = draw(seed)
    result = image_difference(tank.frame, tank.reference, ImagingSettings(num_points=900))
    distances, spurious = matched(tank, result.inclusions)
    assert distances.max() < 0.12
    assert spurious == 0


@pytest.mark.slow
def test_adjacent_bodies_of_one_kind_are_distinguished():
    """Two adjacent resistive bodies merge in the image. Split as disks, and then deformed, they separate."""
    tank = draw(500082)
    distances, spurious = matched(tank, image_difference(tank.frame, tank.reference).inclusions)
    assert distances.max() < 0.05
    assert spurious == 0


@pytest.mark.slow
def test_frames_of_mixed_tanks_equal_those_of_a_model_on_a_fine_mesh():
    """The problem itself: SciPy's voltages of the empty tank equal those of a model on a fine mesh."""
    tank = draw(0, noise=0.0)
    model = ForwardModel(
        Disk(tank.radius).mesh(num_points=8000, refine=tank.reference.electrodes.refinement(Disk(tank.radius))),
        tank.reference.electrodes,
        tank.reference.protocol,
    )
    assert calibrate(model, np.asarray(tank.reference.voltages)[0]).misfit < 1e-3
