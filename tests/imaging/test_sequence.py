"""Breathing lungs in a chest, and a sphere that oscillates ten times a second: frequency, amplitude and phase in
images; and images of the change between two frequencies of the current, against differences that NumPy computes."""

from dataclasses import replace

import numpy as np
import pytest
from test_chosen_frame import EMPTY, FULL, SETTINGS, tank

from jeit import data, protocol
from jeit.electrodes import BoundaryElectrodes, FaceDiscs
from jeit.forward import ForwardModel
from jeit.image import ball_region, half_region, oscillation
from jeit.imaging import ImagingSettings, frequency_weight, image_difference, image_frequencies, image_sequence
from jeit.layout import ring
from jeit.mesh import Disk, Solid, centroids, measures

NOISE = 1e-4


def measured(model, conductivity, domain, times, seed):
    """Frames of conductivities (F, m), with noise."""
    clean = np.stack([np.asarray(model.voltages(one)) for one in conductivity])
    noisy = clean + NOISE * np.abs(clean) * np.random.default_rng(seed).normal(size=clean.shape)
    screened = data.screen(noisy, model.protocol, electrodes=model.electrodes, domain=domain, name="simulated")
    return replace(screened, times=times)


def degrees(phase, expected):
    """Error of a phase, degrees."""
    return np.degrees(np.abs(np.angle(np.exp(1j * (phase - expected)))))


@pytest.fixture(scope="module")
def chest():
    """Two lungs at 0.3 Hz, the right one an eighth of a period late, and a heart at 1.25 Hz: 20 frames a second."""
    domain, times = Disk(0.15), np.arange(300) / 20.0
    model = ForwardModel(
        domain.mesh(num_points=700), BoundaryElectrodes(ring(0.15, 16), 0.02, 0.01), protocol.adjacent(16)
    )
    place = np.asarray(centroids(model.mesh))
    left, right, heart = (np.linalg.norm(place - at, axis=1) < size for at, size in
                          (([-0.07, 0.0], 0.035), ([0.07, 0.0], 0.035), ([0.0, 0.08], 0.03)))  # fmt: skip
    turn = 2 * np.pi * times[:, None]
    changes = -0.15 * np.cos(0.3 * turn) * left - 0.15 * np.cos(0.3 * turn - np.pi / 4) * right
    changes = changes + 0.05 * np.cos(1.25 * turn + 1.0) * heart
    return measured(model, 0.3 * (1 + changes), domain, times, 1)


@pytest.mark.slow
def test_breathing_is_measured_by_frequency_amplitude_and_phase(chest):
    found = image_sequence(chest, settings=ImagingSettings(num_points=500))
    series, mesh = found.series, found.series.mesh
    left, right, heart = (
        ball_region(mesh, at, size) for at, size in (([-0.07, 0], 0.03), ([0.07, 0], 0.03), ([0, 0.08], 0.025))
    )
    slow = oscillation(series.changes, series.times, (0.1, 0.6))
    assert slow.frequency == pytest.approx(0.3, abs=0.005)
    curves = np.stack([series.mean_change(one) for one in (left, right, heart)], axis=1)
    breath = oscillation(curves, series.times, slow.frequency)
    # cos(turn - π/4) with a minus: π - π/4. The other lung's image contributes a few per cent.
    assert degrees(breath.phase[:2], [np.pi, np.pi - np.pi / 4]).max() < 5
    # A smooth image of a change of 0.045 S is lower, in both lungs alike.
    assert breath.amplitude[0] == pytest.approx(breath.amplitude[1], rel=0.1)
    assert 0.4 * 0.045 < breath.amplitude[0] < 1.1 * 0.045
    beat = oscillation(curves[:, 2], series.times, (0.8, 2.5))
    assert beat.frequency == pytest.approx(1.25, abs=0.01)
    assert degrees(beat.phase, 1.0) < 5
    functional = series.functional()
    assert functional[left].mean() > 4 * functional[~(left | right)].mean()
    assert not found.refused.any()
    # Lungs differ in phase by an eighth of a period everywhere in them.
    assert degrees(slow.phase[left], np.pi).max() < 10
    assert np.median(degrees(slow.phase[right], 0.75 * np.pi)) < 5


def test_images_equal_those_of_one_frame_at_a_time(chest):
    few = chest.frames(slice(0, 40))
    found = image_sequence(few, chest.mean_frame(), ImagingSettings(num_points=500, hyperparameter=0.1))
    change = np.asarray(few.voltages) - np.asarray(chest.mean_frame().voltages)
    for frame in (0, 17, 39):
        np.testing.assert_allclose(
            found.series.changes[frame], found.reconstruction.image(change[frame]), rtol=1e-4, atol=1e-7
        )


def test_frames_with_missing_channels_are_refused_and_channels_missing_in_most_are_left_out(chest):
    few = chest.frames(slice(0, 30))
    mask = np.ones(few.mask.shape, bool)
    mask[5, 17], mask[:20, 40] = False, False
    found = image_sequence(replace(few, mask=mask), chest.mean_frame(), ImagingSettings(num_points=500))
    assert np.flatnonzero(found.refused).tolist() == list(found.reasons) == [5]
    assert np.isnan(found.series.changes[5]).all()
    assert not np.asarray(found.reconstruction.matrix)[:, 40].any()


def test_a_frame_of_noise_does_not_refuse_the_others():
    noise = EMPTY * (1 + 0.2 * np.random.default_rng(0).normal(size=EMPTY.shape))
    found = image_sequence(tank(FULL, noise, EMPTY), tank(EMPTY), SETTINGS)
    assert found.refused.tolist() == [False, True, False]
    assert "hides every change" in found.reasons[1]
    assert np.isnan(found.series.changes[1]).all()
    expected = image_difference(tank(FULL), tank(EMPTY), SETTINGS).change
    np.testing.assert_allclose(found.series.changes[0], expected, rtol=1e-4, atol=1e-4 * np.abs(expected).max())
    with pytest.raises(ValueError, match="as noise alone does"):
        image_sequence(tank(noise, noise), tank(EMPTY), SETTINGS)


def test_noise_is_doubted():
    assert not image_sequence(tank(FULL, EMPTY), tank(EMPTY), SETTINGS).doubts
    size = np.linalg.norm(FULL - EMPTY) / np.linalg.norm(EMPTY)
    noisy = FULL + size * EMPTY * np.random.default_rng(0).normal(size=EMPTY.shape)
    (doubt,) = image_sequence(tank(noisy, EMPTY), tank(EMPTY), SETTINGS).doubts
    assert "of the difference from the reference" in doubt


def test_the_change_between_two_frequencies_is_relative_to_that_of_the_whole_body():
    """Unless the weight is left out: then it is the plain difference. The first frequency is the mean of its frames."""
    first, second = tank(0.9 * EMPTY, 1.1 * EMPTY), tank(EMPTY, 1.25 * FULL)
    weighted, plain = (image_frequencies(second, first, SETTINGS, frame=1, weighted=one) for one in (True, False))
    weight = np.linalg.lstsq(EMPTY[:, None], 1.25 * FULL)[0].item()
    assert weighted.weight == pytest.approx(weight, rel=1e-12)
    assert frequency_weight(second.frame(1), first.mean_frame()) == weighted.weight
    assert plain.weight == 1
    for found, scale in ((weighted, weight), (plain, 1.0)):
        expected = image_difference(tank(1.25 * FULL), tank(scale * EMPTY), SETTINGS)
        np.testing.assert_allclose(found.image.change, expected.change, rtol=1e-6, atol=1e-9)
    assert [found.image.reference.name for found in (weighted, plain)] == [f"{weight:.3g} × tank", "tank"]


def test_frequencies_are_weighted_by_the_channels_that_both_use():
    used = np.arange(EMPTY.size) % 7 > 0
    first, second = (replace(one, mask=mask[None]) for one, mask in ((tank(EMPTY), used), (tank(FULL), used[::-1])))
    both = used & used[::-1]
    weight = np.linalg.lstsq(EMPTY[both, None], FULL[both])[0].item()
    assert frequency_weight(second, first) == pytest.approx(weight, rel=1e-12)
    with pytest.raises(ValueError, match="nothing in common"):
        frequency_weight(tank(-FULL), tank(EMPTY))


def test_invalid_series():
    with pytest.raises(ValueError, match="1 frame; a series takes two at least"):
        image_sequence(tank(EMPTY))
    with pytest.raises(ValueError, match="take a linear one"):
        image_sequence(
            replace(tank(EMPTY, FULL), times=np.arange(2.0)), settings=replace(SETTINGS, method="gauss-newton")
        )


@pytest.mark.slow
def test_a_sphere_that_oscillates_ten_times_a_second():
    """In a cylinder with two rings of eight electrodes, at 100 frames a second: frequency, phase and place."""
    domain, times = Solid(Disk(0.1), 0.12), np.arange(100) / 100.0
    position = np.concatenate([np.column_stack([ring(0.1, 8), np.full(8, height)]) for height in (0.04, 0.08)])
    electrodes = FaceDiscs(position, 0.012, 1e-3)
    model = ForwardModel(
        domain.mesh(num_points=2500, refine=electrodes.refinement(domain)), electrodes, protocol.haar(16)
    )
    centre = np.array([0.04, 0.02, 0.06])
    inside = np.linalg.norm(np.asarray(centroids(model.mesh)) - centre, axis=1) < 0.025
    conductivity = 0.2 * (1 + 0.5 * np.cos(2 * np.pi * 10 * times[:, None] - 0.6) * inside)
    made = measured(model, conductivity, domain, times, 2)
    found = image_sequence(made, settings=ImagingSettings(num_points=2000, contact="common"))
    series = found.series
    ball = ball_region(series.mesh, centre, 0.025)
    fitted = oscillation(series.changes, series.times, (5, 20))
    assert fitted.frequency == pytest.approx(10, abs=0.05)
    curve = oscillation(series.mean_change(ball), series.times, fitted.frequency)
    assert degrees(curve.phase, -0.6) < 5
    # A smooth image of it is weak: the oscillation has half of the contrast between images of both ends, at rest.
    ends = model.voltages(0.2 * (1 + 0.5 * inside)) - model.voltages(0.2 * (1 - 0.5 * inside))
    still = np.asarray(found.reconstruction.image(ends)) / 2
    size = np.asarray(measures(series.mesh))[ball]
    assert curve.amplitude == pytest.approx(still[ball] @ size / size.sum(), rel=0.05)
    peak = np.asarray(centroids(series.mesh))[np.argmax(fitted.amplitude)]
    assert np.linalg.norm(peak - centre) < 0.025
    assert series.unit == "S/m"
    upper = half_region(series.mesh, (0, 0, 1))
    assert fitted.amplitude[upper].mean() == pytest.approx(
        fitted.amplitude[~upper].mean(), rel=0.3
    )  # it is at half height


@pytest.mark.slow
def test_a_spike_in_one_channel_changes_no_image(chest):
    """It is replaced, with a note. The frame is not refused."""
    few = chest.frames(slice(0, 6))
    faulty = np.array(few.voltages)
    faulty[2, 40] *= 2
    settings = ImagingSettings(num_points=500, hyperparameter=0.1)
    sound, found = (image_sequence(one, few.frames([5]), settings) for one in (few, replace(few, voltages=faulty)))
    assert not found.refused.any()
    size = np.abs(sound.series.changes).max()
    assert np.abs(found.series.changes - sound.series.changes).max() < 0.05 * size
    assert any("replaced by what others determine" in note for note in found.prepared.measurement.notes)
