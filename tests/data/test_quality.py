"""Quality checks: masked channels, estimated noise, and refused frames."""

from dataclasses import replace

import jax
import numpy as np
import pytest

from jeit import data, protocol
from jeit.data.frame_checks import MIN_SIGNAL_EVIDENCE, assess
from jeit.data.inferred_properties import channel_gains
from jeit.data.quality import channel_reciprocity_error, expected_signs, rounding_deviation, signal_evidence
from jeit.data.screening import mask_spikes
from jeit.inverse import relative_noise
from jeit.report.hyperparameter_rules import report_measurement


def test_missing_saturated_and_dead_channels_are_masked_and_noted(tank, setup):
    chosen = protocol.adjacent(16)
    voltages = tank(chosen) * (1 + 1e-3 * np.random.default_rng(0).normal(size=208))
    voltages[[3, 50]] = np.nan, np.inf
    stuck = np.arange(60, 68)
    voltages[stuck] = 2 * np.abs(voltages[np.isfinite(voltages)]).max()
    dead = np.asarray(chosen.drive_index) == 12
    voltages[dead] *= 1e-6
    measurement = data.screen(voltages, chosen, **setup(16))
    mask = np.asarray(measurement.mask)[0]
    np.testing.assert_array_equal(np.flatnonzero(~mask), np.sort([3, 50, *stuck, *np.flatnonzero(dead)]))
    for expected in ("2 of 208 voltages masked: NaN", "8 of 208 voltages masked: saturated", "current did not flow"):
        assert any(expected in note for note in measurement.notes)
    # Masked channels do not contribute to the sums.
    assert data.reciprocity_error(measurement) < 5e-3
    np.testing.assert_array_equal(measurement.filled()[0, ~mask], 0)


@pytest.mark.parametrize(("patterns", "named"), [(protocol.adjacent, "5"), (protocol.opposite, "5, 13")])
def test_channels_that_read_an_electrode_without_current_are_masked_and_noted(tank, patterns, named):
    chosen = patterns(16)
    voltages, drives, reads = tank(chosen), np.asarray(chosen.channel_drive)[:, 4], chosen.channel_measurement
    voltages[drives != 0] *= 1e-6
    floating = (np.asarray(reads)[:, 4] != 0) & (drives == 0)
    voltages[floating] = np.random.default_rng(0).normal(size=floating.sum())
    measurement = data.screen(np.stack([tank(chosen), voltages]), chosen)
    mask, others = np.asarray(measurement.mask), [int(one) - 1 for one in named.split(", ")]
    assert mask[0].all()
    np.testing.assert_array_equal(mask[1], (drives == 0) & ~np.any(np.asarray(reads)[:, others] != 0, axis=1))
    assert any(f"they read electrode {named}, through which" in note for note in measurement.notes)


def test_channels_of_an_electrode_are_kept_if_one_of_its_drives_carries_current(tank):
    chosen = protocol.adjacent(16)
    voltages = tank(chosen)
    dead = np.asarray(chosen.drive_index) == 12
    voltages[dead] *= 1e-6
    np.testing.assert_array_equal(np.asarray(data.screen(voltages, chosen).mask)[0], ~dead)


def test_a_given_limit_masks_saturated_channels(tank):
    chosen = protocol.adjacent(16)
    voltages = tank(chosen)
    limit = 0.3 * np.abs(voltages).max()
    measurement = data.screen(np.clip(voltages, -limit, limit), chosen, saturation=limit)
    np.testing.assert_array_equal(np.asarray(measurement.mask)[0], np.abs(voltages) < limit)


def test_symmetric_simulated_data_are_not_taken_for_saturated(tank):
    # On a homogeneous disk 32 of 208 voltages share the largest magnitude, but so does every other level.
    voltages = np.round(tank(protocol.adjacent(16)), 12)
    assert np.asarray(data.screen(voltages, protocol.adjacent(16)).mask).all()


def test_an_all_zero_frame_among_others_is_masked(tank):
    chosen = protocol.adjacent(8)
    measurement = data.screen(np.stack([tank(chosen), np.zeros(40)]), chosen)
    assert np.asarray(measurement.mask).all(axis=1).tolist() == [True, False]


@pytest.mark.parametrize("chosen", [protocol.adjacent(16), protocol.skip(16, 2, measurement_skipped=0)])
def test_noise_is_estimated_from_reciprocity(tank, chosen):
    if chosen.name.startswith("skip"):  # spanned by neighbours only with the driven electrodes
        chosen = protocol.skip(16, 2, measurement_skipped=0, driven_electrodes=True)
    clean, deviation = tank(chosen), 1e-5
    noisy = clean + deviation * np.random.default_rng(3).normal(size=clean.shape)
    estimate = data.estimate_noise(data.screen(noisy, chosen))
    assert estimate is not None
    assert estimate.method == "reciprocity"
    # The median of about 100 values scatters by 10 %.
    assert estimate.standard_deviation == pytest.approx(deviation, rel=0.3)
    assert estimate.relative == pytest.approx(deviation / np.sqrt(np.mean(clean**2)), rel=0.3)
    assert data.reciprocity_error(data.screen(clean, chosen)) < 1e-12


def test_noise_is_estimated_from_repeated_frames(tank):
    chosen = protocol.opposite(16)
    noisy = tank(chosen) + 1e-5 * np.random.default_rng(4).normal(size=(20, 96))
    estimate = data.estimate_noise(data.screen(noisy, chosen))
    assert estimate is not None
    assert estimate.method == "repeated frames"
    assert estimate.standard_deviation == pytest.approx(1e-5, rel=0.1)
    assert data.estimate_noise(data.screen(noisy[:2], chosen)) is None


def test_channel_reciprocity_error_locates_the_channel(tank):
    chosen = protocol.adjacent(16)
    voltages = tank(chosen)
    voltages[17] *= 1.5
    error = channel_reciprocity_error(data.screen(voltages, chosen))[0]
    assert np.argmax(np.abs(error)) in (17, *(p for pair in chosen.reciprocal_pairs()[0] if 17 in pair for p in pair))
    assert np.sum(np.abs(error) > 1e-10) == 2
    assert np.isnan(channel_reciprocity_error(data.screen(tank(protocol.opposite(8)), protocol.opposite(8)))).all()


@pytest.mark.parametrize(
    ("chosen", "all_known"),
    [
        (protocol.adjacent(16, driven_electrodes=True), True),
        (protocol.opposite(16, driven_electrodes=True), True),
        (protocol.two_terminal(7), True),
        # Pairs on different sides of the driven pair: their sign depends on the body.
        (protocol.skip(15, 3, measurement_skipped=1), False),
        (protocol.all_against_one(12), True),
    ],
)
@pytest.mark.parametrize("clockwise", [True, False])
def test_expected_signs(tank, chosen, all_known, clockwise):
    count = chosen.num_electrodes
    order = np.roll(np.arange(count)[:: 1 if clockwise else -1], 3)
    signs = expected_signs(chosen, order)
    assert np.all(signs != 0) == all_known
    assert np.count_nonzero(signs) > 0.3 * len(signs)
    known = signs != 0
    np.testing.assert_array_equal(signs[known], np.sign(tank(chosen))[known])


def test_signs_of_noise_are_wrong_half_the_time(tank, setup):
    chosen = protocol.adjacent(16)
    assert data.impossible_signs(data.screen(tank(chosen), chosen, **setup(16))) == 0
    noise = np.random.default_rng(5).normal(size=208)
    fraction = data.impossible_signs(data.screen(noise, chosen, **setup(16)))
    assert fraction is not None
    assert fraction[0] == pytest.approx(0.5, abs=0.15)  # four standard deviations of a binomial
    assert data.impossible_signs(data.screen(noise, chosen)) is None


def test_noise_in_the_difference_is_refused(tank, setup):
    chosen = protocol.adjacent(16)
    clean, other = tank(chosen), tank(chosen, change=0.02)
    trusted = np.asarray(relative_noise(clean))
    size = np.sqrt(np.mean(((other - clean) / trusted) ** 2))
    noise = size * trusted * np.random.default_rng(6).normal(size=208)
    reference = data.screen(clean, chosen, **setup(16))
    little = data.screen(other + 0.1 * noise, chosen, **setup(16))
    (quality,) = data.check_imageable(little, reference)
    # Independent noise of relative size 0.1 breaks reciprocity by about √2 times as much.
    assert quality.difference_reciprocity_error == pytest.approx(0.14, rel=0.2)
    as_much = data.screen(other + noise, chosen, **setup(16))
    (quality,) = data.check_imageable(as_much, reference)
    assert quality.difference_reciprocity_error == pytest.approx(1, rel=0.2)
    too_much = data.screen(other + 5 * noise, chosen, **setup(16))
    with pytest.raises(ValueError, match=r"breaks reciprocity .* as noise alone does"):
        data.check_imageable(too_much, reference)
    assert [q.imageable for q in assess(too_much, reference)] == [False]


def test_noise_of_one_electrode_is_attributed_to_it_and_a_common_factor_does_not_hide_noise(tank, setup):
    chosen, rng = protocol.adjacent(16), np.random.default_rng(9)
    clean, other = tank(chosen), tank(chosen, change=0.02)
    reference = data.screen(clean, chosen, **setup(16))
    loose = np.asarray(chosen.channel_measurement)[:, 4] != 0
    (quality,) = assess(data.screen(other * (1 + 0.1 * loose * rng.normal(size=208)), chosen, **setup(16)), reference)
    assert quality.noisy_electrode == 4
    assert "most of it in the channels of electrode 5" in quality.doubt
    noisy = clean * (1 + 0.02 * rng.normal(size=208))
    for factor in (1.0, 1.1, 2.0):
        (quality,) = assess(data.screen(factor * noisy, chosen, **setup(16)), reference)
        assert quality.noise_share > 0.9
        assert quality.noisy_electrode is None
        assert "shown where none are" in quality.doubt
    (quality,) = assess(data.screen(1.1 * other, chosen, **setup(16)), reference)
    assert quality.noise_share < 1e-6
    assert not quality.doubt


def test_channels_in_another_order_than_in_the_reference_are_refused_with_that_cause(tank, setup):
    chosen = protocol.adjacent(16)
    reference = data.screen(tank(chosen), chosen, **setup(16))
    drives = np.asarray(chosen.drive_index)
    order = np.concatenate([np.flatnonzero(drives == drive)[::-1] for drive in range(16)])
    (quality,) = assess(data.screen(tank(chosen, change=0.02)[order], chosen, **setup(16)), reference)
    assert "in the order of the reference's" in quality.reason


@pytest.mark.parametrize("driven_electrodes", [False, True])
def test_the_evidence_of_a_signal_in_noise_alone_is_about_zero(tank, driven_electrodes):
    chosen = protocol.adjacent(16, driven_electrodes=driven_electrodes)
    deviation = np.asarray(relative_noise(tank(chosen)))
    noise = deviation * np.random.default_rng(8).normal(size=(100, len(deviation)))
    evidence = np.array([signal_evidence(data.screen(one, chosen), deviation) for one in noise])
    assert abs(evidence.mean()) < 0.4  # four standard deviations of the mean
    assert np.std(evidence) == pytest.approx(1, rel=0.3)
    assert np.mean(evidence > MIN_SIGNAL_EVIDENCE) < 0.03


@pytest.mark.parametrize("patterns", [protocol.adjacent, protocol.haar])
def test_the_opposite_sign_is_refused_where_the_protocol_implies_no_sign(tank, patterns):
    """In solids the protocol implies no sign. If imaged, the change would be twice the voltages."""
    chosen = patterns(16)
    reference = data.screen(tank(chosen), chosen)
    data.check_imageable(data.screen(tank(chosen, change=0.5), chosen), reference)
    with pytest.raises(ValueError, match="opposite sign of its reference's: reverse the polarity"):
        data.check_imageable(data.screen(-tank(chosen, change=0.5), chosen), reference)


def test_optimal_currents_are_not_taken_for_noise(tank, setup):
    """Optimal currents diagonalise the change: reciprocity compares off-diagonal values, which are pure noise here."""
    full = protocol.haar(16)
    empty = data.transfer_impedance(data.screen(tank(full), full))[0]
    touched = empty + 1e-5 * empty @ np.diag(np.arange(16.0)) @ empty
    best = protocol.optimal(empty, touched, number=8, current=1e-3)
    potentials = [(np.asarray(best.drive) @ one)[np.asarray(best.drive_index)] for one in (empty, touched)]
    clean, other = (np.einsum("kl,kl->k", best.channel_measurement, one) for one in potentials)
    noise = 0.02 * np.abs(other - clean).max() * np.random.default_rng(7).normal(size=(2, len(clean)))
    reference = data.screen(clean + noise[0], best, **setup(16))
    (quality,) = data.check_imageable(data.screen(other + noise[1], best, **setup(16)), reference)
    assert quality.difference_reciprocity_error < 0.2
    with pytest.raises(ValueError, match="breaks reciprocity"):
        data.check_imageable(data.screen(clean + 10 * noise[1], best, **setup(16)), reference)


def test_large_voltages_of_driven_electrodes_are_not_taken_for_noise(tank, setup):
    """One per cent of the voltages on driven electrodes, mostly of contacts, exceeds the change of the other
    channels."""
    chosen = protocol.adjacent(16, driven_electrodes=True)
    shared = (np.asarray(chosen.channel_drive) * np.asarray(chosen.channel_measurement)).sum(axis=1)
    contact = 30 * np.abs(tank(chosen)).max() * shared / np.abs(shared).max()
    rng = np.random.default_rng(0)
    frames = [(tank(chosen, change=change) + contact) * (1 + 0.01 * rng.normal(size=256)) for change in (0.5, 0.0)]
    assert data.reciprocity_error(data.screen(frames[0] - frames[1], chosen)) > 0.63
    noisy = [data.screen(one, chosen, **setup(16)) for one in frames]
    (quality,) = data.check_imageable(*noisy)
    assert quality.difference_reciprocity_error < 0.3


def test_too_few_channels_are_refused(tank, setup):
    chosen = protocol.adjacent(16)
    reference = data.screen(tank(chosen), chosen, **setup(16))
    with pytest.raises(ValueError, match="only 9 channels"):
        data.check_imageable(data.screen(1.1 * tank(chosen), chosen, mask=np.arange(208) < 9), reference)


def test_a_reference_with_channels_in_another_order_is_named(tank, setup):
    chosen = protocol.adjacent(16)
    clean = tank(chosen)
    rolled = np.roll(clean.reshape(16, 13), 3, axis=1).ravel()
    good, bad = (
        data.screen(one, chosen, **setup(16), name=name) for one, name in ((1.1 * clean, "it"), (rolled, "that"))
    )
    with pytest.raises(ValueError, match=r"the reference 'that' breaks reciprocity by .* another order than described"):
        data.check_imageable(good, bad)
    with pytest.raises(ValueError, match="the frame breaks reciprocity"):
        data.check_imageable(bad, good)
    assert "reciprocity broken by" in report_measurement(bad)["wiring"]


def test_reversed_polarity_is_named(tank, setup):
    chosen = protocol.adjacent(16)
    reference = data.screen(-tank(chosen), chosen, **setup(16))
    with pytest.raises(ValueError, match="reverse the polarity"):
        data.check_imageable(data.screen(-1.1 * tank(chosen), chosen, **setup(16)), reference)


def test_different_units_are_named(tank):
    chosen = protocol.adjacent(16)
    with pytest.raises(ValueError, match="millivolts"):
        data.check_imageable(data.screen(1e3 * tank(chosen), chosen), data.screen(tank(chosen), chosen))


def test_frames_masks_and_mean(tank, setup):
    chosen = protocol.adjacent(8)
    voltages = np.stack([tank(chosen), 3 * tank(chosen)])
    voltages[0, 5] = np.nan
    measurement = data.screen(voltages, chosen, frame_names=("reference", "press"), **setup(8))
    assert measurement.frame("press").num_frames == 1
    np.testing.assert_array_equal(measurement.frame(-1).voltages, measurement.frame("press").voltages)
    mean = measurement.mean_frame()
    assert float(mean.voltages[0, 4]) == pytest.approx(2 * tank(chosen)[4])
    assert float(mean.voltages[0, 5]) == pytest.approx(3 * tank(chosen)[5])
    fewer = measurement.without_electrodes(2)
    assert fewer.notes[-1].endswith("electrodes 3 left out.")
    np.testing.assert_array_equal(fewer.mask[1], chosen.mask_without(2))
    driven = data.screen(tank(protocol.two_terminal(5)), protocol.two_terminal(5)).without_driven_channels()
    assert not np.asarray(driven.mask).any()


def test_a_measurement_is_a_pytree(tank, setup):
    chosen = protocol.adjacent(8)
    measurement = data.screen(tank(chosen), chosen, **setup(8))
    doubled = jax.jit(lambda m: 2 * m.filled())(measurement)
    np.testing.assert_allclose(doubled, 2 * measurement.voltages)


def rounded(voltages, digits):
    return np.array([float(f"{one:.{digits - 1}e}") for one in voltages])


@pytest.mark.parametrize("to", ["digits", "step", "single precision"])
def test_rounding_deviation_is_that_of_the_rounded_voltages(to):
    rng = np.random.default_rng(0)
    voltages = 1e-3 * rng.lognormal(size=208) * rng.choice([-1, 1], 208)
    seen = 1.7e-5 * np.round(voltages / 1.7e-5) if to == "step" else rounded(voltages, 3)
    if to == "single precision":
        seen = seen.astype(np.float32).astype(float)
    error, deviation = seen - voltages, rounding_deviation(seen, np.ones(208, bool))
    assert np.std(error / deviation) == pytest.approx(1, abs=0.1)
    assert not rounding_deviation(voltages, np.ones(208, bool)).any()


def test_rounding_is_reported_as_noise_where_reciprocity_does_not_show_it(tank):
    chosen = protocol.adjacent(16)
    seen = 1e-5 * np.round(tank(chosen) / 1e-5)
    report = report_measurement(data.screen(seen, chosen))
    assert "where electrodes are" in report["smallest_detectable_body"]["not_known_because"]
    noise = report["noise"]
    assert noise == {"standard_deviation": pytest.approx(1e-5 / np.sqrt(12)), "method": "rounding"}


def test_the_smallest_detectable_body_is_that_of_a_frame_with_usable_voltages(tank, setup):
    chosen, draws = protocol.adjacent(16), np.random.default_rng(0).normal(size=(2, 208))
    clean = tank(chosen)
    noisy = clean * (1 + 1e-4 * draws)

    def smallest_body(voltages, **described):
        return report_measurement(data.screen(voltages, chosen, **described))["smallest_detectable_body"]

    described = setup(16)
    found = smallest_body(noisy, **described)
    assert 0 < found["diameter_in_half_of_the_domain"] < found["diameter_almost_everywhere"]
    assert found["limited_by"].startswith("the noise, from ")
    with_empty_frame = np.stack([np.full(208, np.nan), *noisy])
    without_first = smallest_body(with_empty_frame, **described)
    assert without_first["diameter_almost_everywhere"] == pytest.approx(found["diameter_almost_everywhere"], rel=0.5)
    without_reference = smallest_body(with_empty_frame, frame_names=("reference", "left", "right"), **described)
    assert without_reference == {"not_known_because": "no voltage can be used"}


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        (lambda clean: clean, "the voltages have no noise"),
        (
            lambda clean: clean * np.random.default_rng(0).choice([-1, 1], 208),
            "a sign that the body described cannot give",
        ),
        (lambda clean: clean * (1 + 1e-4j), "real voltages only"),
    ],
)
def test_reasons_for_which_the_smallest_detectable_body_is_not_known(change, reason, tank, setup):
    chosen = protocol.adjacent(16)
    report = report_measurement(data.screen(change(tank(chosen)), chosen, **setup(16)))
    assert reason in report["smallest_detectable_body"]["not_known_because"]


def test_masked_voltages_do_not_hide_rounding():
    voltages = rounded(np.random.default_rng(1).normal(size=100), 2)
    voltages[3], mask = np.pi, np.arange(100) != 3
    assert rounding_deviation(voltages, mask)[mask].all()


@pytest.mark.parametrize("driven", [False, True])
@pytest.mark.parametrize("size", [1, 30])
def test_spikes_in_single_channels_are_masked_and_named(driven, size, tank, setup):
    """Spikes as large as the largest change, and far larger; `fill` replaces them by the values from reciprocity."""
    chosen, rng = protocol.adjacent(16, driven_electrodes=driven), np.random.default_rng(0)
    empty = data.screen(tank(chosen), chosen, **setup(16))
    noise = 1e-4 * np.abs(tank(chosen)) * rng.normal(size=(3, chosen.num_measurements))
    valid = data.screen(tank(chosen, 0.05) + noise, chosen, **setup(16))
    assert mask_spikes(valid, empty) is valid
    disturbed, each = np.array(valid.voltages), np.asarray(relative_noise(np.abs(tank(chosen))))
    largest = np.abs((tank(chosen, 0.05) - tank(chosen)) / each).max()
    disturbed[1, [17, 100]] += size * largest * each[[17, 100]] * [1, -1]
    spiky = data.screen(disturbed, chosen, **setup(16))
    found = mask_spikes(spiky, empty)
    assert {(1, 17), (1, 100)} <= {*map(tuple, np.argwhere(~np.asarray(found.mask)).tolist())}
    assert (~np.asarray(found.mask)).sum() <= 3
    assert "contradict the other channels (channel 18 of frame 1, channel 101 of frame 1" in found.notes[-1]
    if size > 1:
        filled = mask_spikes(spiky, empty, fill=True)
        assert np.asarray(filled.mask).all()
        np.testing.assert_allclose(filled.voltages[1, [17, 100]], valid.voltages[1, [17, 100]], rtol=2e-3)
        assert filled.notes[-1].startswith("2 voltages replaced by what others determine")


def test_small_errors_of_a_channel_are_kept(tank, setup):
    """An error smaller than the typical change is kept, however precise the other channels are: an image treats it as
    noise."""
    chosen = protocol.adjacent(16)
    empty = data.screen(tank(chosen), chosen, **setup(16))
    touched = tank(chosen, 0.05)
    each = np.asarray(relative_noise(np.abs(tank(chosen))))
    typical = np.sqrt(np.mean(((touched - tank(chosen)) / each) ** 2))
    touched[17] += 0.3 * typical * each[17]
    off = data.screen(touched, chosen, **setup(16))
    assert mask_spikes(off, empty) is off


def test_no_spike_is_found_where_channels_are_independent(tank, setup):
    """A light touch between two electrodes changes their channel alone."""
    chosen = protocol.two_terminal(8)
    empty = data.screen(tank(chosen), chosen, **setup(8))
    touched = tank(chosen)
    touched[3] *= 1.1
    touched = data.screen(touched, chosen, **setup(8))
    assert mask_spikes(touched, empty) is touched


def test_gains_of_measurements_follow_from_reciprocity(tank, setup):
    chosen = protocol.adjacent(16)
    gains = np.exp(0.1 * np.random.default_rng(0).normal(size=16))
    uneven = np.asarray(tank(chosen)) * gains[np.asarray(chosen.measurement_index)]
    measurement = data.screen(uneven, chosen, **setup(16))
    found, error = channel_gains(measurement)
    np.testing.assert_allclose(found / gains, np.mean(found / gains), rtol=1e-3)
    assert error is not None
    assert error < 1e-3 < data.reciprocity_error(measurement)
    few = measurement.mask & (np.asarray(chosen.drive_index) < 3)
    assert channel_gains(replace(measurement, mask=few)) == (None, None)
