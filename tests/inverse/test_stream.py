"""Streams: every frame against `reconstruct` and the textbook Kalman filter, and refused frames."""

import numpy as np
import pytest

from jeit.electrodes import PointElectrodes
from jeit.forward import ForwardModel
from jeit.inverse import Gaussian, Imager, Parametrisation, TotalVariation, reconstruct, stream
from jeit.inverse.nonlinear import GaussNewton, LevenbergMarquardt, OneStep, Scale
from jeit.inverse.streaming.stream import FrameCheck, FrameStatus
from jeit.layout import ring
from jeit.mesh import Disk, centroids
from jeit.protocol import adjacent

RADIUS = 0.1
PLACES = [(0.05 * np.cos(angle), 0.05 * np.sin(angle)) for angle in np.linspace(0, 0.5, 6)]


def near(model, place):
    return np.linalg.norm(np.asarray(centroids(model.mesh)) - place, axis=1) < 0.03


def pressed(model, value, place=PLACES[0]):
    """Voltages of a body of 1 S with `value` within 30 mm of a place."""
    return np.asarray(model.voltages(np.where(near(model, place), value, 1.0)))


def settings(model):
    return {"prior": Gaussian(0.02), "noise": 2e-3 * np.abs(pressed(model, 1.0)), "hyperparameter": 3.0}


def moving(model):
    """A moving press: half the conductivity within 30 mm, with noise of 0.1 %."""
    clean = np.stack([pressed(model, 0.5, place) for place in PLACES])
    return clean + 1e-3 * np.abs(pressed(model, 1.0)) * np.random.default_rng(0).normal(size=clean.shape)


@pytest.fixture(scope="module")
def model():
    """A model with sixteen electrodes, for linear images."""
    electrodes = PointElectrodes(ring(0.9 * RADIUS, 16))
    return ForwardModel(Disk(RADIUS).mesh(num_points=120), electrodes, adjacent(16))


@pytest.fixture(scope="module")
def small():
    """A model with six electrodes and 25 nodes for iterative images, which take two seconds to compile even so."""
    electrodes = PointElectrodes(ring(0.9 * RADIUS, 6))
    return ForwardModel(Disk(RADIUS).mesh(num_points=25), electrodes, adjacent(6))


@pytest.fixture(scope="module")
def frames(model):
    return moving(model)


@pytest.fixture(scope="module")
def few(small):
    return moving(small)


@pytest.fixture(scope="module")
def options(model):
    return settings(model)


@pytest.fixture(scope="module")
def rough(small):
    return settings(small)


@pytest.fixture(scope="module")
def imager(small, rough):
    """Gauss-Newton with four steps a frame."""
    return Imager.create(small, 1.0, **rough)


@pytest.fixture(scope="module")
def damped(small, rough):
    """With Levenberg-Marquardt steps."""
    return Imager.create(small, 1.0, solver=LevenbergMarquardt(), **rough)


@pytest.fixture(scope="module")
def linear(model, options):
    return Imager.create(model, 1.0, solver=OneStep(), **options)


@pytest.fixture(scope="module")
def clean(linear, frames):
    """The last image of valid frames."""
    return list(stream(linear, frames))[-1].conductivity


def darkest(model, conductivity):
    return np.asarray(centroids(model.mesh))[np.argmin(conductivity)]


def assert_press_is_followed(model, one, frames, least, apart):
    images = list(stream(one, iter(frames)))
    assert [image.number for image in images] == list(range(len(PLACES)))
    assert {image.status for image in images} == {"imaged"}
    for image, place in zip(images, PLACES, strict=True):
        assert np.linalg.norm(darkest(model, image.conductivity) - place) < apart
        assert image.conductivity.min() < least
        assert 0 < image.latency < 5


def test_linear_images_follow_the_press(model, frames, linear):
    assert_press_is_followed(model, linear, frames, 0.7, 0.03)


def test_iterated_images_follow_the_press(small, few, imager):
    assert_press_is_followed(small, imager, few, 0.75, 0.03)  # whose cells are as large as the press


def test_iterations_converge_to_reconstruct(small, few, imager, rough):
    image = list(stream(imager, few))[-1]
    best = reconstruct(small, few[-1], 1.0, solver=GaussNewton(rtol=1e-10), **rough)
    error = np.linalg.norm(image.conductivity - best.conductivity) / np.linalg.norm(best.conductivity - 1)
    assert error < 0.02
    assert image.misfit == pytest.approx(float(best.misfit), rel=0.02)
    assert 1 <= image.iterations <= 4


def test_the_linear_image_is_the_first_step_of_gauss_newton(small, few, imager, rough):
    """For changes so small that the first step suffices."""
    rest = pressed(small, 1.0)
    faint = rest + 1e-5 * (few[:3] - rest)
    straight = Imager.create(small, 1.0, solver=OneStep(), **rough)
    for frame in faint:
        one, step = (next(iter(stream(method, [frame]))).conductivity - 1 for method in (straight, imager))
        np.testing.assert_allclose(one, step, atol=1e-4 * np.abs(step).max())


def test_a_reference_removes_the_model_error(small, few, rough):
    rest = pressed(small, 1.0)
    gain = 1 + 0.05 * np.cos(np.arange(len(rest)))
    imager = Imager.create(small, 1.0, reference=gain * rest, **rough)
    image = next(iter(stream(imager, few * gain)))
    assert np.linalg.norm(darkest(small, image.conductivity) - PLACES[0]) < 0.03


def test_frames_of_noise_alone_are_reported_as_unchanged(model, linear):
    """Noise alone, an undisturbed frame, and a press weaker than the noise of a channel."""
    rest, faint, rng = pressed(model, 1.0), pressed(model, 0.9), np.random.default_rng(1)
    noise = 0.7 * np.median(np.abs(faint - rest)) / np.median(np.abs(rest)) * np.abs(rest)
    frames = [rest + noise * rng.normal(size=208), rest, faint + noise * rng.normal(size=208)]
    quiet, equal, found = stream(linear, frames)
    assert [one.status for one in (quiet, equal, found)] == ["unchanged", "unchanged", "imaged"]
    assert "by chance" in quiet.reason
    assert "equals an undisturbed frame" in equal.reason
    assert quiet.imaged


@pytest.mark.slow
def test_streams_with_total_variation():
    """A constant frame converges to `reconstruct`; with five electrodes, to limit compilation."""
    electrodes = PointElectrodes(ring(0.9 * RADIUS, 5))
    tiny = ForwardModel(Disk(RADIUS).mesh(num_points=16), electrodes, adjacent(5))
    frame = np.asarray(tiny.voltages(np.where(np.asarray(centroids(tiny.mesh))[:, 0] > 0.03, 0.5, 1.0)))
    options = {**settings(tiny), "prior": TotalVariation(), "hyperparameter": 30.0}
    image = list(stream(Imager.create(tiny, 1.0, **options), [frame] * 100))[-1]
    best = reconstruct(tiny, frame, 1.0, solver=GaussNewton(max_steps=1000, rtol=1e-12), **options).conductivity
    np.testing.assert_allclose(image.conductivity, best, atol=1e-4 * np.ptp(best))
    assert np.ptp(best) > 0.2


@pytest.mark.slow
def test_both_descents_converge_to_the_same_image(few, imager, damped):
    """For a constant frame, because each frame starts from the last image."""
    images = [list(stream(one, [few[0]] * 6))[-1] for one in (imager, damped)]
    assert {image.status for image in images} == {"imaged"}
    np.testing.assert_allclose(images[0].conductivity, images[1].conductivity, rtol=1e-4)


@pytest.fixture(scope="module")
def noisy(small):
    """Sixty frames of one press with ten times the noise."""
    noise = 1e-2 * np.abs(pressed(small, 1.0))
    return pressed(small, 0.9) + noise * np.random.default_rng(0).normal(size=(60, len(noise))), noise


MEMORY = 30.0  # the same in all tests, so that it is compiled once


@pytest.mark.parametrize("memory", [MEMORY, pytest.param(3.0, marks=pytest.mark.slow)])
def test_a_memory_equals_the_kalman_filter(memory, small, noisy):
    """The textbook filter with all covariances, iterated until they are steady."""
    frames, noise = noisy
    options = {"prior": Gaussian(0.03), "noise": noise, "hyperparameter": 2.0, "solver": OneStep()}
    options["parametrisation"] = Parametrisation(informative=0.0)
    image = list(stream(Imager.create(small, 1.0, memory=memory, **options), frames))[-1].conductivity

    inversion = Imager.create(small, 1.0, **options).inversion
    shapes = np.asarray(inversion.basis.shapes, float)
    voltages, jacobian = small.voltages_and_jacobian(np.ones(small.mesh.num_cells))
    rows = np.asarray(jacobian) @ shapes
    keep, state, covariance = np.exp(-1 / memory), np.zeros(len(shapes.T)), np.eye(len(shapes.T))
    # The press has lasted long before the filter's variances are steady, so start it from its steady state.
    for _ in range(300):
        inverse = np.linalg.inv(rows @ covariance @ rows.T + np.diag(noise**2))
        gain = covariance @ rows.T @ inverse
        covariance = keep**2 * (covariance - gain @ rows @ covariance) + (1 - keep**2) * np.eye(len(state))
    for frame in frames:
        state = keep * state
        state = state + gain @ (frame - np.asarray(voltages) - rows @ state)
    np.testing.assert_allclose(image - 1, shapes @ state, atol=1e-3 * np.abs(shapes @ state).max())


@pytest.mark.parametrize("method", ["one-step", pytest.param("gauss-newton", marks=pytest.mark.slow)])
def test_a_memory_reduces_noise_and_keeps_the_press(method, small, noisy):
    """With little information in a single frame: a prior of 5 % and much noise."""
    frames, noise = noisy
    options = {"prior": Gaussian(0.02), "noise": noise, "hyperparameter": 20.0, "solver": method}
    options["parametrisation"] = Parametrisation(informative=1e-6)
    alone, kept = (
        np.array([one.conductivity for one in stream(Imager.create(small, 1.0, memory=memory, **options), frames)])
        for memory in (0.0, MEMORY)
    )
    inside = near(small, PLACES[0])
    press = [images[20:, inside].mean(axis=1) for images in (alone, kept)]
    assert press[1].std() < 0.75 * press[0].std()
    assert abs(press[1].mean() - 0.9) < abs(press[0].mean() - 0.9)


@pytest.mark.slow
def test_a_memory_with_gauss_newton_equals_the_linear_one(small, noisy):
    """For changes and noise a hundred times smaller, one step from the predicted image is the filter's update."""
    rest, (frames, noise) = pressed(small, 1.0), noisy
    options = {"prior": Gaussian(0.02), "noise": noise / 100, "hyperparameter": 2000.0, "memory": MEMORY}
    options["parametrisation"] = Parametrisation(informative=1e-6)
    faint = rest + (frames - rest) / 100
    linear, iterated = (
        list(stream(Imager.create(small, 1.0, solver=method, **options), faint))[-1].conductivity - 1
        for method in ("one-step", "gauss-newton")
    )
    np.testing.assert_allclose(iterated, linear, atol=0.002 * np.abs(linear).max())


def with_fault(frames, fault):
    """Frames with a fault in the third."""
    faulty = [frame.copy() for frame in frames]
    faulty[2] = fault(faulty[2])
    return faulty


def dead_electrode(frame, electrode=4):
    frame[np.asarray(adjacent(16).channels_touching(electrode))] = 0
    return frame


def dead_part(frame, electrode=4):
    return np.where(adjacent(16).channels_touching(electrode), frame, 0)


def fading_electrode(frame):
    """The electrode reads two fifths, so that the frame differs by a quarter only."""
    return frame - 0.6 * dead_part(frame)


def with_nan(frame):
    frame[[3, 60, 61]] = np.nan
    return frame


def half_gone(frame):
    frame[:110] = np.inf
    return frame


def clipped(frame):
    """The amplifier saturates at three fifths of the largest voltage."""
    return np.clip(frame, -0.6 * np.abs(frame).max(), 0.6 * np.abs(frame).max())


def at_both_rails(frame):
    return np.copysign(2 * np.abs(frame).max(), frame)


def amplified_and_clipped(frame):
    return clipped(3 * frame)


REFUSED = {
    "at the rails": (at_both_rails, "Saturated: 208 channels at the ends"),
    "at the rails in part, and all wrong": (amplified_and_clipped, "channels, and the others are far off too"),
    "all zero": (np.zeros_like, "current source"),
    "another sensor, one electrode worse": (lambda frame: dead_electrode(3 * frame) - 20 * dead_part(frame), "another"),
    "all NaN": (lambda frame: frame * np.nan, "Only 0 of 208"),
    "half gone": (half_gone, "can be used"),
    "another protocol": (lambda frame: frame[:96], "208 real voltages"),
    "too large to square": (lambda frame: 1e300 * frame, "another sensor"),
    "another sensor": (lambda frame: 3 * frame, "another sensor"),
    "shuffled": (lambda frame: np.roll(frame, 5), "another sensor"),
    "complex": (lambda frame: frame + 1j, "real voltages"),
    "text": (lambda frame: "no frame at all", "is text"),
    "ragged": (lambda frame: [[1.0, 2.0], [3.0]], "ragged"),
    "masked": (lambda frame: np.ma.masked_array(frame, mask=True), "Only 0 of 208"),
    "nothing": (lambda frame: None, "real voltages"),
}


@pytest.mark.parametrize("name", REFUSED)
def test_a_faulty_frame_is_refused_and_the_stream_continues(name, frames, linear, clean):
    fault, message = REFUSED[name]
    images = list(stream(linear, with_fault(frames, fault)))
    assert images[2].status == "refused"
    assert message in images[2].reason
    assert images[2].conductivity is None
    assert not images[2].imaged
    np.testing.assert_allclose(images[-1].conductivity, clean, rtol=0.02)


@pytest.mark.parametrize(
    ("fault", "status", "message"),
    [
        (lambda frame: frame * np.nan, "refused", "Only 0 of 18"),
        (lambda frame: 3 * frame, "refused", "another sensor"),
        (lambda frame: np.where(np.arange(18) % 7 == 3, np.nan, frame), "partial", "3 channels"),
    ],
)
def test_iterations_continue_from_the_last_image_after_a_faulty_frame(fault, status, message, few, imager):
    """One frame with too few channels, and one with enough."""
    images, clean = list(stream(imager, with_fault(few, fault))), list(stream(imager, few))
    assert images[2].status == status
    assert message in images[2].reason
    assert images[2].imaged == (status == "partial")
    assert images[3].status == "imaged"
    if images[2].imaged:
        change = images[2].conductivity - clean[2].conductivity
        assert np.linalg.norm(change) < 0.3 * np.linalg.norm(clean[2].conductivity - 1)
    np.testing.assert_allclose(images[-1].conductivity, clean[-1].conductivity, rtol=0.02)


@pytest.mark.parametrize(
    ("fault", "left", "message"),
    [
        (with_nan, 205, "3 channels"),
        (clipped, 176, "32 channels at the ends of the range"),
        (dead_electrode, 156, "Electrode 5"),
        (fading_electrode, 156, "Electrode 5"),
    ],
)
def test_channels_without_a_reading_are_left_out(fault, left, message, model, frames, linear):
    images = list(stream(linear, with_fault(frames, fault)))
    assert images[2].status == "partial"
    assert message in images[2].reason
    assert images[2].usable.sum() == left
    assert np.linalg.norm(darkest(model, images[2].conductivity) - PLACES[2]) < 0.04
    assert images[3].status == "imaged"


@pytest.mark.parametrize("method", ["gauss-newton", "one-step"])
def test_masked_channels_are_ignored(method, small, few, rough):
    """Whatever the masked channel reads, the image is the same to rounding."""
    mask = np.arange(len(few[0])) != 7
    imager = Imager.create(small, 1.0, solver=method, mask=mask, **rough)
    read = np.stack([few[0]] * 5)
    read[1:, 7] = [np.nan, -np.inf, 1e300, 0]
    images = list(stream(imager, read))
    assert {image.status for image in images} == {"imaged"}
    first = next(iter(stream(imager, few))).conductivity
    for image in images if method == "one-step" else [next(iter(stream(imager, [frame]))) for frame in read]:
        np.testing.assert_allclose(image.conductivity, first, rtol=1e-6)


def test_regions_are_imaged_as_one(small, few, rough):
    """The cells of a region share one value, and fixed cells do not change."""
    label = 1 + np.arange(small.mesh.num_cells)
    label[near(small, PLACES[0])] = 0
    label[np.asarray(centroids(small.mesh))[:, 0] < -0.05] = -1
    label = np.unique(label, return_inverse=True)[1] - 1
    held, pooled = label == -1, label == 0
    assert held.sum() > 2 < pooled.sum()
    parametrisation = Parametrisation(regions=label, informative=1e-6)
    imager = Imager.create(small, 1.0, parametrisation=parametrisation, **rough)
    image = next(iter(stream(imager, few))).conductivity
    np.testing.assert_allclose(image[held], 1.0, rtol=1e-6)
    assert np.ptp(image[pooled]) < 1e-5
    assert image[pooled].mean() < 0.8


def test_a_frame_that_needs_more_steps_is_reported(small, imager):
    """A press of ten times the conductivity, and back to rest by a shortened step."""
    images = list(stream(imager, [pressed(small, 10.0), pressed(small, 1.0)]))
    assert [image.status for image in images] == ["step limit", "step limit"]
    assert "after 4 iterations:" in images[0].reason
    assert "after 3 iterations and 1 step that led too far:" in images[1].reason
    assert [image.iterations for image in images] == [4, 3]
    assert all(image.imaged for image in images)


def test_an_undisturbed_frame_may_be_reached_by_the_last_step(small, imager):
    """The last step is not checked again; the remaining objective is the most that another step could gain."""
    for value, reached in ((5.0, False), (3.0, True)):
        image = list(stream(imager, [pressed(small, value), pressed(small, 1.0)]))[1]
        assert (np.abs(image.conductivity - 1).max() < 1e-5) == reached
        assert (image.status == "unchanged") == reached
        assert image.iterations == 4


@pytest.mark.parametrize("kind", ["imager", pytest.param("damped", marks=pytest.mark.slow)])
def test_an_undisturbed_frame_is_at_its_minimum(kind, small, few, request):
    """Its objective goes to zero, so that no step is small relative to it."""
    rest = pressed(small, 1.0)
    images = list(stream(request.getfixturevalue(kind), [rest, few[0], rest, rest]))
    assert [str(one.status) for one in images] == ["unchanged", "imaged", "unchanged", "unchanged"]
    for one in images[2:]:
        np.testing.assert_allclose(one.conductivity, 1.0, atol=1e-5)


@pytest.mark.parametrize("kind", ["imager", pytest.param("damped", marks=pytest.mark.slow)])
def test_a_change_far_below_the_noise_is_still_imaged(kind, small, request):
    """The stopping criterion does not prevent the first step."""
    much, little = (
        next(iter(stream(request.getfixturevalue(kind), [pressed(small, 1 - change)]))).conductivity - 1
        for change in (1e-3, 1e-5)
    )
    np.testing.assert_allclose(100 * little, much, atol=0.02 * np.abs(much).max())


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"solver": "magic"}, "gauss-newton"),
        ({"solver": "l-bfgs-b"}, "bounded time; take one of one-step, gauss-newton, levenberg-marquardt"),
        ({"solver": "one-step", "prior": TotalVariation()}, "not linear"),
        ({"parametrisation": Parametrisation(bounds=(0.5, 2.0))}, "bounds: an Imager takes none"),
        ({"parametrisation": Parametrisation(unknowns=[Scale()])}, "unknowns: an Imager takes none"),
        ({"reference": np.ones(96)}, "208 channels"),
        ({"reference": np.zeros(208)}, "current source"),
        ({"mask": np.zeros(208, bool)}, "every channel"),
        ({"noise": 0.0}, "noise"),
        ({"memory": -1.0}, "memory"),
        ({"prior": "noser"}, "Noser"),
        ({"reference": np.array(-1.0)}, "signs"),
        ({"reference": np.array(1e3)}, "SI units"),
        ({"memory": np.nan}, "memory"),
        ({"memory": 5.0, "prior": TotalVariation(), "hyperparameter": 30.0}, "memory"),
    ],
)
def test_bad_input(change, message, model, options):
    if "reference" in change and change["reference"].shape == ():
        change = {"reference": change["reference"] * pressed(model, 1.0)}
    with pytest.raises(ValueError, match=message):
        Imager.create(model, 1.0, **{**options, **change})


def test_one_frame_is_not_a_stream(few, imager):
    with pytest.raises(ValueError, match=r"\[frame\]"):
        list(stream(imager, few[0]))


def test_a_frame_of_noise_alone_is_distinguished_from_a_small_signal_in_larger_noise():
    """By 100 pairs of reciprocal channels with noise of one, and a signal of 0.7 in both channels of each pair."""
    random = np.random.default_rng(0)
    noise, pairs = random.normal(size=200), np.arange(200).reshape(2, 100).T
    signal = np.tile(0.7 * random.choice([-1.0, 1.0], 100), 2)
    expected = np.full(200, 1e3)
    check = FrameCheck(np.ones(200, bool), expected, np.zeros((1, 200), bool), (pairs, np.ones(100)), np.ones(200))
    assert check(expected + noise)[2] == FrameStatus.UNCHANGED
    assert "Nothing but noise" in check(expected + noise)[3]
    assert check(expected + signal + noise)[2] != FrameStatus.UNCHANGED
