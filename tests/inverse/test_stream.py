"""Streams: what comes out frame by frame, and what happens to frames that are no good."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jeit.electrodes import BoundaryElectrodes
from jeit.forward import ForwardModel
from jeit.inverse import Gaussian, Imager, Parametrisation, TotalVariation, reconstruct, stream
from jeit.inverse.nonlinear import GaussNewton, LevenbergMarquardt, OneStep, Scale
from jeit.layout import ring
from jeit.mesh import Disk, centroids
from jeit.protocol import adjacent

RADIUS = 0.1
PLACES = [(0.05 * np.cos(angle), 0.05 * np.sin(angle)) for angle in np.linspace(0, 0.5, 6)]


@pytest.fixture(scope="module")
def model():
    electrodes = BoundaryElectrodes(ring(RADIUS, 16), 0.012, 1e-3)
    return ForwardModel(Disk(RADIUS).mesh(num_points=300), electrodes, adjacent(16))


def near(model, place):
    return np.linalg.norm(np.asarray(centroids(model.mesh)) - place, axis=1) < 0.03


@pytest.fixture(scope="module")
def frames(model):
    """A press that moves: half the conductivity within 30 mm, with noise of 0.1 %."""
    key = jax.random.key(0)
    rest = model.voltages(1.0)
    clean = jnp.stack([model.voltages(jnp.where(near(model, place), 0.5, 1.0)) for place in PLACES])
    return np.asarray(clean + 1e-3 * jnp.abs(rest) * jax.random.normal(key, clean.shape))


@pytest.fixture(scope="module")
def options(model):
    noise = 2e-3 * jnp.abs(model.voltages(1.0))
    return {"prior": Gaussian(0.02), "noise": noise, "hyperparameter": 3.0}


@pytest.fixture(scope="module")
def imager(model, options):
    return Imager.create(model, 1.0, solver=GaussNewton(max_steps=4), **options)


@pytest.fixture(scope="module")
def linear(model, options):
    return Imager.create(model, 1.0, solver=OneStep(), **options)


def darkest(model, conductivity):
    return np.asarray(centroids(model.mesh))[np.argmin(conductivity)]


def test_images_follow_the_press(model, frames, imager, linear):
    for one in (imager, linear):
        images = list(stream(one, iter(frames)))
        assert [image.number for image in images] == list(range(len(PLACES)))
        assert {image.status for image in images} == {"imaged"}
        for image, place in zip(images, PLACES, strict=True):
            assert np.linalg.norm(darkest(model, image.conductivity) - place) < 0.03
            assert image.conductivity.min() < 0.7
            assert 0 < image.latency < 5


def test_iterations_end_where_reconstruct_does(model, frames, imager, options):
    image = list(stream(imager, frames))[-1]
    best = reconstruct(model, frames[-1], 1.0, solver=GaussNewton(rtol=1e-10), **options)
    error = np.linalg.norm(image.conductivity - best.conductivity) / np.linalg.norm(best.conductivity - 1)
    assert error < 0.02
    assert image.misfit == pytest.approx(float(best.misfit), rel=0.02)
    assert 1 <= image.iterations <= 4


def test_the_linear_image_is_the_first_step_of_gauss_newton(model, frames, linear, options):
    image = next(iter(stream(linear, frames)))
    first = Imager.create(model, 1.0, solver=GaussNewton(max_steps=1), **options)
    step = first.estimate(jnp.asarray(frames[0]), first.weighing(first.mask), first.start)
    change = image.conductivity - 1
    np.testing.assert_allclose(change, np.log(step.conductivity), atol=1e-4 * np.abs(change).max())


def test_a_reference_takes_the_model_error_out(model, frames, options):
    gain = 1 + 0.05 * np.cos(np.arange(208))
    imager = Imager.create(model, 1.0, reference=gain * np.asarray(model.voltages(1.0)), **options)
    image = next(iter(stream(imager, frames * gain)))
    assert np.linalg.norm(darkest(model, image.conductivity) - PLACES[0]) < 0.03


def test_frames_of_nothing_but_noise_are_said_to_be_unchanged(model, options):
    """Noise alone, an undisturbed frame, and a press that is fainter than the noise of a channel."""
    rest, rng = np.asarray(model.voltages(1.0)), np.random.default_rng(1)
    pressed = np.asarray(model.voltages(jnp.where(near(model, PLACES[0]), 0.9, 1.0)))
    noise = 0.7 * np.median(np.abs(pressed - rest)) * np.ones(208)
    imager = Imager.create(model, 1.0, reference=rest, **{**options, "noise": noise})
    frames = [rest + noise * rng.normal(size=208), rest, pressed + noise * rng.normal(size=208)]
    quiet, equal, found = stream(imager, frames)
    assert [one.status for one in (quiet, equal, found)] == ["unchanged", "unchanged", "imaged"]
    assert "by chance" in quiet.reason
    assert "equals an undisturbed frame" in equal.reason
    assert quiet.imaged


def test_total_variation_streams_too(model, frames, options):
    imager = Imager.create(
        model, 1.0, prior=TotalVariation(), noise=options["noise"], hyperparameter=30.0, solver=GaussNewton(max_steps=6)
    )
    image = list(stream(imager, frames[:2]))[-1]
    assert image.imaged
    assert np.linalg.norm(darkest(model, image.conductivity) - PLACES[1]) < 0.03


@pytest.fixture(scope="module")
def noisy(model):
    """Sixty frames of one press, with ten times the noise."""
    rest, pressed = model.voltages(1.0), model.voltages(jnp.where(near(model, PLACES[0]), 0.9, 1.0))
    noise = 1e-2 * np.abs(rest)
    return np.asarray(pressed) + noise * np.random.default_rng(0).normal(size=(60, 208)), noise


@pytest.mark.parametrize("memory", [3.0, pytest.param(20.0, marks=pytest.mark.slow)])
def test_a_memory_is_the_kalman_filter(memory, model, noisy):
    """The textbook's, with all covariances, long enough for them to be steady."""
    frames, noise = noisy
    options = {"prior": Gaussian(0.03), "noise": noise, "hyperparameter": 2.0, "solver": OneStep()}
    options["parametrisation"] = Parametrisation(informative=0.0)
    image = list(stream(Imager.create(model, 1.0, memory=memory, **options), frames))[-1].conductivity

    inversion = Imager.create(model, 1.0, **options).inversion
    shapes = np.asarray(inversion.basis.shapes, float)
    voltages, jacobian = model.voltages_and_jacobian(jnp.ones(model.mesh.num_cells))
    rows = np.asarray(jacobian) @ shapes
    keep, state, covariance = np.exp(-1 / memory), np.zeros(len(shapes.T)), np.eye(len(shapes.T))
    # The press has gone on for long before the filter's variances are steady: so start it from its steady state.
    for _ in range(300):
        inverse = np.linalg.inv(rows @ covariance @ rows.T + np.diag(noise**2))
        gain = covariance @ rows.T @ inverse
        covariance = keep**2 * (covariance - gain @ rows @ covariance) + (1 - keep**2) * np.eye(len(state))
    for frame in frames:
        state = keep * state
        state = state + gain @ (frame - np.asarray(voltages) - rows @ state)
    np.testing.assert_allclose(image - 1, shapes @ state, atol=1e-3 * np.abs(shapes @ state).max())


@pytest.mark.parametrize("method", ["one-step", "gauss-newton"])
def test_a_memory_takes_noise_out_and_leaves_the_press(method, model, noisy):
    """Where a frame alone tells little: a prior of 5 % and much noise."""
    frames, noise = noisy
    options = {"prior": Gaussian(0.03), "noise": noise, "hyperparameter": 20.0, "solver": method}
    alone, kept = (
        np.array([one.conductivity for one in stream(Imager.create(model, 1.0, memory=memory, **options), frames)])
        for memory in (0.0, 50.0)
    )
    inside = near(model, PLACES[0])
    press = [images[20:, inside].mean(axis=1) for images in (alone, kept)]
    assert press[1].std() < 0.75 * press[0].std()
    assert abs(press[1].mean() - 0.9) < abs(press[0].mean() - 0.9)


def test_a_memory_is_the_same_to_gauss_newton_where_all_is_linear(model, noisy):
    """Changes a hundred times smaller, and noise too: one step from the expected image is the filter's update."""
    rest, (frames, noise) = np.asarray(model.voltages(1.0)), noisy
    options = {"prior": Gaussian(0.03), "noise": noise / 100, "hyperparameter": 200.0, "memory": 2.0}
    small = rest + (frames[:6] - rest) / 100
    linear, iterated = (
        list(stream(Imager.create(model, 1.0, solver=method, **options), small))[-1].conductivity - 1
        for method in ("one-step", "gauss-newton")
    )
    np.testing.assert_allclose(iterated, linear, atol=0.01 * np.abs(linear).max())


def spoil(frames, fault):
    """Frames with one of them spoilt; the third."""
    spoilt = [frame.copy() for frame in frames]
    spoilt[2] = fault(spoilt[2])
    return spoilt


def dead_electrode(frame, electrode=4):
    frame[np.asarray(adjacent(16).channels_touching(electrode))] = 0
    return frame


def dead_part(frame, electrode=4):
    return np.where(adjacent(16).channels_touching(electrode), frame, 0)


def fading_electrode(frame):
    """It reads two fifths, so that the frame differs by a quarter only."""
    return frame - 0.6 * dead_part(frame)


def with_nan(frame):
    frame[[3, 60, 61]] = np.nan
    return frame


def half_gone(frame):
    frame[:110] = np.inf
    return frame


def clipped(frame):
    """The amplifier gives no more than three fifths of the largest voltage."""
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


@pytest.mark.parametrize("method", ["gauss-newton", "one-step"])
@pytest.mark.parametrize("name", REFUSED)
def test_a_bad_frame_is_refused_and_the_stream_goes_on(name, method, frames, imager, linear):
    fault, message = REFUSED[name]
    one = imager if method == "gauss-newton" else linear
    images = list(stream(one, spoil(frames, fault)))
    assert images[2].status == "refused"
    assert message in images[2].reason
    assert images[2].conductivity is None
    assert not images[2].imaged
    clean = list(stream(one, frames))
    np.testing.assert_allclose(images[-1].conductivity, clean[-1].conductivity, rtol=0.02)


@pytest.mark.parametrize("method", ["gauss-newton", "one-step"])
@pytest.mark.parametrize(
    ("fault", "left", "message"),
    [
        (with_nan, 205, "3 channels"),
        (clipped, 176, "32 channels at the ends of the range"),
        (dead_electrode, 156, "Electrode 5"),
        (fading_electrode, 156, "Electrode 5"),
    ],
)
def test_channels_without_a_reading_are_left_out(fault, left, message, method, model, frames, imager, linear):
    one = imager if method == "gauss-newton" else linear
    images = list(stream(one, spoil(frames, fault)))
    assert images[2].status == "partial"
    assert message in images[2].reason
    assert images[2].usable.sum() == left
    assert np.linalg.norm(darkest(model, images[2].conductivity) - PLACES[2]) < 0.04
    assert images[3].status == "imaged"


@pytest.mark.parametrize("method", ["gauss-newton", "one-step"])
def test_a_masked_channel_is_not_looked_at(method, model, frames, options):
    """Whatever it reads: the same image to rounding."""
    mask = np.arange(208) != 7
    imager = Imager.create(model, 1.0, solver=method, mask=mask, **options)
    read = np.stack([frames[0]] * 5)
    read[1:, 7] = [np.nan, -np.inf, 1e300, 0]
    images = list(stream(imager, read))
    assert {image.status for image in images} == {"imaged"}
    first = next(iter(stream(imager, frames))).conductivity
    for image in images if method == "one-step" else [next(iter(stream(imager, [frame]))) for frame in read]:
        np.testing.assert_allclose(image.conductivity, first, rtol=1e-6)


def test_both_descents_end_at_the_same_image(model, frames, options):
    images = [
        next(iter(stream(Imager.create(model, 1.0, solver=kind(max_steps=20, rtol=1e-9), **options), frames)))
        for kind in (GaussNewton, LevenbergMarquardt)
    ]
    assert {image.status for image in images} == {"imaged"}
    np.testing.assert_allclose(images[0].conductivity, images[1].conductivity, rtol=1e-4)


def test_regions_are_imaged_as_one(model, frames, options):
    """A region's cells share one value, and those that are held do not move."""
    label = np.where(np.linalg.norm(np.asarray(centroids(model.mesh)), axis=1) > 0.08, -1, 0)
    label[near(model, PLACES[0])] = 1
    imager = Imager.create(model, 1.0, parametrisation=Parametrisation(regions=label), **options)
    image = next(iter(stream(imager, frames))).conductivity
    np.testing.assert_allclose(image[label == -1], 1.0, rtol=1e-6)
    assert np.ptp(image[label == 1]) < 1e-5
    assert image[label == 1].mean() < 0.8


def test_a_frame_that_needs_more_steps_is_said_so(model, frames, options):
    imager = Imager.create(model, 1.0, solver=GaussNewton(max_steps=1, rtol=1e-9), **options)
    image = next(iter(stream(imager, frames)))
    assert image.status == "step limit"
    assert "after 1 iteration:" in image.reason
    assert image.imaged


def test_steps_that_led_too_far_are_told_from_iterations(model, options):
    """From a press that conducts a hundredfold back to rest in three steps, of which some are shortened."""
    pressed, rest = (model.voltages(jnp.where(near(model, PLACES[0]), value, 1.0)) for value in (100.0, 1.0))
    weak = {**options, "hyperparameter": 1.0, "solver": GaussNewton(max_steps=3, rtol=1e-9)}
    image = list(stream(Imager.create(model, 1.0, **weak), [pressed, rest]))[1]
    assert image.status == "step limit"
    assert image.iterations == 1
    assert "after 1 iteration and 2 steps that led too far:" in image.reason


@pytest.mark.parametrize("kind", [GaussNewton, LevenbergMarquardt])
def test_an_undisturbed_frame_is_at_its_minimum(kind, model, frames, options):
    """Its objective goes to nothing, so that no step is small beside it."""
    rest = model.voltages(1.0)
    imager = Imager.create(model, 1.0, solver=kind(), **options)
    images = list(stream(imager, [rest, frames[0], rest, rest]))
    assert [str(one.status) for one in images] == ["unchanged", "imaged", "unchanged", "unchanged"]
    for one in images[2:]:
        np.testing.assert_allclose(one.conductivity, 1.0, atol=1e-5)


def test_an_undisturbed_frame_may_be_reached_by_the_last_step(model, options):
    """Which is not looked at again: but what is left of the objective is all that a step could lower."""
    rest = model.voltages(1.0)
    pressed = model.voltages(jnp.where(near(model, PLACES[0]), 0.3, 1.0))
    for steps in (3, 4, 5):
        imager = Imager.create(model, 1.0, solver=GaussNewton(max_steps=steps), **options)
        image = list(stream(imager, [pressed, rest]))[1]
        close = np.abs(image.conductivity - 1).max() < 1e-5
        assert (image.status == "unchanged") == close


@pytest.mark.parametrize("kind", [GaussNewton, LevenbergMarquardt])
def test_a_change_far_below_the_noise_is_still_imaged(kind, model, options):
    """What ends the iteration does not keep it from its first step."""
    label = near(model, PLACES[0])
    small, smaller = (
        next(iter(stream(Imager.create(model, 1.0, solver=kind(), **options), [frame]))).conductivity - 1
        for frame in (model.voltages(jnp.where(label, 1 - change, 1.0)) for change in (1e-3, 1e-5))
    )
    np.testing.assert_allclose(100 * smaller, small, atol=0.02 * np.abs(small).max())


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
        change = {"reference": change["reference"] * np.asarray(model.voltages(1.0))}
    with pytest.raises(ValueError, match=message):
        Imager.create(model, 1.0, **{**options, **change})


def test_one_frame_is_not_a_stream(frames, imager):
    with pytest.raises(ValueError, match=r"\[frame\]"):
        list(stream(imager, frames[0]))
