"""Properties of a protocol: reciprocity, redundant channels, masks, subsets, and JAX transformations."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jeit import protocol
from jeit.protocol.reciprocity import transfer_between_drives


def voltages(chosen, seed=0):
    """Voltages of an arbitrary body, which is any symmetric transfer impedance."""
    factor = np.random.default_rng(seed).normal(size=(chosen.num_electrodes,) * 2)
    potentials = np.asarray(chosen.drive) @ (factor @ factor.T)
    return np.einsum("kl,kl->k", chosen.channel_measurement, potentials[np.asarray(chosen.drive_index)])


@pytest.mark.parametrize(
    ("chosen", "count"),
    [
        (protocol.adjacent(16), 104),
        (protocol.adjacent(16, reciprocal="half"), 0),
        (protocol.skip(12, 2), 54),
        (protocol.all_against_one(8), 21),
        (protocol.opposite(16), 0),
        (protocol.reference_electrode(16), 0),
    ],
)
def test_voltages_of_reciprocal_pairs_have_the_stated_ratio(chosen, count):
    pairs, ratio = chosen.reciprocal_pairs()
    assert len(pairs) == count
    measured = voltages(chosen)
    np.testing.assert_allclose(measured[pairs[:, 1]], ratio * measured[pairs[:, 0]], rtol=1e-10)


def test_reciprocity_with_unequal_currents_and_reversed_pairs():
    drive = np.diag([1e-3, -2e-3, 5e-4, 1e-3]) @ np.asarray(protocol.adjacent(4).measurement)
    chosen = protocol.from_matrices(drive, protocol.adjacent(4).measurement)
    pairs, ratio = chosen.reciprocal_pairs()
    assert len(pairs) == 6
    assert len(set(ratio)) > 1
    measured = voltages(chosen)
    np.testing.assert_allclose(measured[pairs[:, 1]], ratio * measured[pairs[:, 0]], rtol=1e-10)


def test_transfer_between_drives_is_symmetric_where_known():
    # Skip-1 drives are sums of two neighbours, so that adjacent measurements span all of them.
    chosen = protocol.skip(8, 1, measurement_skipped=0, driven_electrodes=True)
    random = np.random.default_rng(2)
    measured, deviation = voltages(chosen), random.uniform(0.5, 2, chosen.num_measurements)
    patterns = [np.asarray(one) for one in (chosen.drive, chosen.measurement)]
    indices = [np.asarray(one) for one in (chosen.drive_index, chosen.measurement_index)]
    mask = np.ones(chosen.num_measurements, bool)
    transfer, known, noise = transfer_between_drives(*patterns, *indices, measured[None], mask, deviation)
    assert known.all()
    np.testing.assert_allclose(transfer[0], transfer[0].T, rtol=1e-9, atol=1e-12 * np.abs(transfer).max())
    # By least squares with these deviations for the potentials against the last electrode.
    weights = 1 / deviation[indices[0] == 3] ** 2
    rows = patterns[1][indices[1][indices[0] == 3]]
    reduced = rows[:, :-1]
    covariance = np.linalg.inv(reduced.T @ (weights[:, None] * reduced))
    drive = patterns[0][:, :-1]
    np.testing.assert_allclose(noise[:, 3] ** 2, np.einsum("si,ij,sj->s", drive, covariance, drive), rtol=1e-9)
    # Without two channels of a drive, only the combinations that the others span are known. The rest is as before.
    lost = np.flatnonzero(indices[0] == 3)[[1, 4]]
    mask[lost] = False
    spoilt = np.where(mask, measured, 1e6)
    transfer_without, known_without, _ = transfer_between_drives(*patterns, *indices, spoilt[None], mask, deviation)
    across = drives_across(patterns[1][indices[1][lost]], patterns[0])
    np.testing.assert_array_equal(known_without[:, 3], ~across)
    assert known_without[:, np.arange(8) != 3].all()
    np.testing.assert_array_equal(transfer_without[..., np.arange(8) != 3], transfer[..., np.arange(8) != 3])


def test_of_drives_with_one_channel_only_its_own_voltage_is_known():
    chosen = protocol.two_terminal(3, current=2e-3)
    arrays = map(np.asarray, (chosen.drive, chosen.measurement, chosen.drive_index, chosen.measurement_index))
    used = np.array([True, True, False])
    transfer, known, noise = transfer_between_drives(*arrays, np.array([[1.0, 2.0, 3.0]]), used)
    np.testing.assert_array_equal(known, np.diag(used))
    np.testing.assert_allclose(np.diag(transfer[0])[:2], [2e-3, 4e-3])
    np.testing.assert_allclose(np.diag(noise)[:2], 2e-3)


def drives_across(lost_pairs, drives):
    """Whether each pair of `drives` joins the two parts into which a ring falls without its edges `lost_pairs`."""
    number = drives.shape[1]
    cuts = [row.argmax() for row in lost_pairs]  # the edge from electrode k to k + 1
    part = np.isin(np.arange(number), np.arange(min(cuts) + 1, max(cuts) + 1))
    return np.abs(drives @ part) > 0


def test_protocols_are_the_same_if_all_their_channels_are():
    chosen = protocol.skip(8, 1)
    assert chosen.same_patterns(chosen.subset(np.arange(chosen.num_measurements)))
    for change in ({"current": 2e-3}, {"order": "fixed"}):
        assert not chosen.same_patterns(protocol.skip(8, 1, **change)), change
    assert not protocol.haar(8, measurement="mean").same_patterns(protocol.haar(8, measurement="mean-removed"))
    assert not protocol.haar(8).same_patterns(protocol.haar(8).subset(np.arange(55)))
    assert not protocol.two_terminal(4, [(0, 1)]).same_patterns(protocol.two_terminal(5, [(0, 1)]))


def test_channels_touching_an_electrode():
    chosen = protocol.adjacent(16)
    touching = chosen.channels_touching(3)
    # Two drives of 13 channels; of the other 14 drives, those two away lose one channel and the rest two.
    assert touching.sum() == 2 * 13 + 2 * 1 + 12 * 2
    np.testing.assert_array_equal(chosen.mask_without(3), ~touching)
    uses = (np.asarray(chosen.channel_drive) != 0) | (np.asarray(chosen.channel_measurement) != 0)
    np.testing.assert_array_equal(chosen.channels_touching([3, 7]), uses[:, 3] | uses[:, 7])


def test_redundant_channels_are_those_beyond_the_rank_of_their_drive():
    """Counted drive by drive; differences of two electrodes are measured one by one."""
    ring = protocol.adjacent(6, driven_electrodes=True)
    assert np.linalg.matrix_rank(ring.measurement) == 5
    assert ring.repeated_facts() == 0
    # L voltages against the mean of the others, of which L - 1 are independent.
    for number in (3, 8):
        for kind in ("mean", "mean-removed"):
            chosen = protocol.haar(number, measurement=kind)
            assert chosen.repeated_facts() == number - 1, (number, kind)
            all_but_one = np.arange(1, chosen.num_measurements)
            assert chosen.repeated_facts(all_but_one) == number - 2, (number, kind)
            assert chosen.repeated_facts(all_but_one[::-1]) == number - 2, (number, kind)
    # The first drive is measured between neighbours only, the second also against the mean.
    rows = np.concatenate([ring.measurement, protocol.measurement_patterns(6, "mean")])
    select = np.array([[True] * 6 + [False] * 6, [True] * 12])
    assert protocol.from_matrices(np.asarray(ring.drive)[:2], rows, select).repeated_facts() == 12 - 5


def test_subset_gives_the_same_voltages():
    chosen = protocol.adjacent(16)
    keep = chosen.mask_without([0, 5])
    fewer = chosen.subset(keep)
    assert fewer.num_measurements == keep.sum()
    assert fewer.num_drives == 12
    np.testing.assert_allclose(voltages(fewer), voltages(chosen)[keep], rtol=1e-14)
    assert chosen.subset([7, 3]).num_measurements == 2


@pytest.mark.parametrize(
    ("keep", "lesson"),
    [
        (np.ones(5, bool), "one True or False per channel"),
        (np.zeros(40, bool), "no channel is left"),
        ([40], "from 0 to 39"),
        ([-1], "from 0 to 39"),
        ([0.5], "integers"),
    ],
)
def test_bad_subsets(keep, lesson):
    with pytest.raises(ValueError, match=lesson):
        protocol.adjacent(8).subset(keep)


@pytest.mark.parametrize("electrodes", [8, -1, [-1, 3], [0, 8], [[0, 1]], 1.0, True])
def test_electrodes_that_do_not_exist(electrodes):
    with pytest.raises(ValueError, match="0 to 7"):
        protocol.adjacent(8).channels_touching(electrodes)


def test_no_electrodes_touch_no_channel():
    assert not protocol.adjacent(8).channels_touching([]).any()


def test_jit_vmap_and_grad_pass_through():
    def power(current):
        # Built inside the transformation: checks of values must not evaluate tracers.
        chosen = protocol.adjacent(8, current=current)
        return jnp.sum(chosen.channel_drive**2)

    np.testing.assert_allclose(jax.jit(power)(2e-3), power(2e-3), rtol=1e-14)
    np.testing.assert_allclose(jax.grad(power)(1.0), 2 * power(1.0), rtol=1e-14)
    chosen = protocol.adjacent(8)
    batched = jax.vmap(lambda scale, p: jnp.sum(scale * p.channel_drive**2), in_axes=(0, None))
    np.testing.assert_allclose(batched(jnp.arange(3.0), chosen), jnp.arange(3.0) * power(1e-3), rtol=1e-14)
