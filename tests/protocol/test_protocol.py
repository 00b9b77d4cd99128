"""Properties of a protocol: reciprocity, masks, subsets, and JAX transformations."""

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
    transfer, known, gain = transfer_between_drives(
        np.asarray(chosen.drive),
        np.asarray(chosen.measurement),
        np.asarray(chosen.drive_index),
        np.asarray(chosen.measurement_index),
        voltages(chosen)[None],
        np.ones(chosen.num_measurements, bool),
    )
    assert known.all()
    assert np.all(gain > 0)
    np.testing.assert_allclose(transfer[0], transfer[0].T, rtol=1e-9, atol=1e-12 * np.abs(transfer).max())


def test_channels_touching_an_electrode():
    chosen = protocol.adjacent(16)
    touching = chosen.channels_touching(3)
    # Two drives of 13 channels; of the other 14 drives, those two away lose one channel and the rest two.
    assert touching.sum() == 2 * 13 + 2 * 1 + 12 * 2
    np.testing.assert_array_equal(chosen.mask_without(3), ~touching)
    uses = (np.asarray(chosen.channel_drive) != 0) | (np.asarray(chosen.channel_measurement) != 0)
    np.testing.assert_array_equal(chosen.channels_touching([3, 7]), uses[:, 3] | uses[:, 7])


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
        ([0.5], "integers"),
    ],
)
def test_bad_subsets(keep, lesson):
    with pytest.raises(ValueError, match=lesson):
        protocol.adjacent(8).subset(keep)


def test_electrodes_that_do_not_exist():
    with pytest.raises(ValueError, match="0 to 7"):
        protocol.adjacent(8).channels_touching(8)


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
