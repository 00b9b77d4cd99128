"""Whether frames can be imaged, and the quality of measurements: noise, reciprocity, dead channels.

Checks of the quality of measurements: noise, reciprocity, dead channels, and the order of electrodes.

Quality of voltages, computed from themselves alone: reciprocity, noise, and signs that no passive body gives.

Everything here works on one measurement alone; no model of the body is needed.

Check that electrodes on an edge are numbered in the order in which they follow each other along it.

A layout may be numbered in any order. But two exchanged rows of a table of positions look the same, spoil every image,
and go unnoticed; so such an order is reported, with what the signs of the voltages, which depend on the order, say of
it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from jeit.arguments import counted, percent
from jeit.data.measurement import Measurement
from jeit.electrodes import BoundaryElectrodes
from jeit.inverse import relative_noise
from jeit.mesh.topology import along
from jeit.protocol import Protocol
from jeit.protocol.reciprocity import transfer_between_drives

# Enough frames to judge a recording by; a long one is sampled evenly.
_MOST_FRAMES = 32


@dataclass(frozen=True)
class NoiseEstimate:
    """The noise of one voltage.

    - `standard_deviation`: volts (root mean square).
    - `relative`: the same, over the root mean square of the usable voltages.
    - `method`: "reciprocity" or "repeated frames".
    """

    standard_deviation: float
    relative: float
    method: str


def reciprocity_error(measurement: Measurement, deviation: Float[np.ndarray, " M"] | None = None) -> float | None:
    """Relative departure from reciprocity: ‖T - Tᵀ‖ / ‖T‖ with T the transfer between drives.

    `deviation` (M,): expected errors of the channels, relative to each other; T is divided by its errors for those. All
    alike unless given.

    T_ij is what drive pattern i would read while drive j flows, combined from the measured channels (see
    `jeit.protocol.reciprocity.transfer_between_drives`); it is symmetric for every body, so that what is left is
    noise, drift and gain error, or a wrong protocol. Independent noise of relative size ε gives about √2 ε.

    Returns None when the protocol ties no two usable channels together.
    """
    error, noise, signal = _asymmetry(measurement, deviation)
    if error.size == 0:
        return None
    if deviation is not None:
        error = error / noise
    size = np.linalg.norm(signal)
    return float(np.linalg.norm(error) / size) if size > 0 else 0.0


def channel_reciprocity_error(measurement: Measurement) -> Float[np.ndarray, "F M"]:
    """(F, M) volts: each voltage minus the value predicted by its reciprocal channel; NaN without one."""
    pairs, ratio = measurement.protocol.reciprocal_pairs()
    voltages, mask = np.asarray(measurement.voltages), np.asarray(measurement.mask)
    result = np.full(voltages.shape, np.nan, dtype=voltages.dtype)
    if len(pairs) == 0:
        return np.abs(result)
    first, second = pairs.T
    both = mask[:, first] & mask[:, second]
    error = voltages[:, first] - voltages[:, second] / ratio
    result[:, first] = np.where(both, error, np.nan)
    result[:, second] = np.where(both, -error * ratio, np.nan)
    return np.real(result) if np.isrealobj(voltages) else np.abs(result)


def estimate_noise(measurement: Measurement) -> NoiseEstimate | None:
    """The noise of one voltage, from reciprocity or else from repeated frames; None without either.

    - Reciprocity: two channels that must be equal differ by √2 standard deviations; combinations of channels
      accordingly. Includes drift and gain errors, which cancel in a difference of two frames: estimate the
      noise of a difference from the difference.
    - Repeated frames (8 or more, no frame names): differences of successive frames.

    Robust: 1.4826 times the median absolute value, which half of the channels cannot upset.
    """
    voltages, mask = np.asarray(measurement.voltages), np.asarray(measurement.mask)
    size = float(np.sqrt(np.mean(np.abs(voltages[mask]) ** 2))) if mask.any() else 0.0
    error, gain, _ = _asymmetry(measurement)
    if error.size:
        deviation = _robust_deviation(error / gain)
        method = "reciprocity"
    elif measurement.num_frames >= 8 and not measurement.frame_names:
        step = np.diff(voltages, axis=0)[mask[1:] & mask[:-1]]
        deviation = _robust_deviation(step / np.sqrt(2)) if step.size else 0.0
        method = "repeated frames"
    else:
        return None
    return NoiseEstimate(deviation, deviation / size if size > 0 else float("inf"), method)


def expected_signs(protocol: Protocol, order: Int[np.ndarray, " L"]) -> Int[np.ndarray, " M"]:
    """(M,) the sign that each voltage has on every passive body; 0 where it depends on the body.

    On the boundary of a simply connected sheet the potential falls monotonically from source to sink along
    both arcs between them: a local extremum elsewhere would contradict the maximum principle, whatever the
    (positive) conductivity. So a voltage between two electrodes of one arc has a known sign. `order` lists
    the electrodes as they follow each other along the boundary; channels that drive or measure otherwise than
    in pairs get 0.
    """
    count = protocol.num_electrodes
    rank = np.empty(count, dtype=int)
    rank[order] = np.arange(len(order))
    drive, measurement = np.asarray(protocol.channel_drive), np.asarray(protocol.channel_measurement)
    pairs = (np.count_nonzero(drive, axis=1) == 2) & (np.count_nonzero(measurement, axis=1) == 2)
    source = rank[drive.argmax(axis=1)]
    # Ranks counted from the source: 0 ... sink is the falling arc, sink ... count the rising one.
    sink = (rank[drive.argmin(axis=1)] - source) % count
    plus = (rank[measurement.argmax(axis=1)] - source) % count
    minus = (rank[measurement.argmin(axis=1)] - source) % count
    falling = (plus <= sink) & (minus <= sink)
    signs = np.where(falling, np.sign(minus - plus), 0)
    plus, minus = np.where(plus == 0, count, plus), np.where(minus == 0, count, minus)
    rising = (plus >= sink) & (minus >= sink) & ~falling
    return np.where(pairs, np.where(rising, np.sign(plus - minus), signs), 0)


def impossible_signs(
    measurement: Measurement, order: Int[np.ndarray, " L"] | None = None
) -> Float[np.ndarray, " F"] | None:
    """(F,) fraction of the usable voltages whose sign no passive body gives (real part of complex voltages).

    Voltages that are nothing but noise have the wrong sign half the time: the fraction of such channels is
    about twice the value returned. `order` lists the electrodes as they follow each other along the boundary; by their
    positions unless given. None when the electrodes are not known to lie around the boundary of an
    outline, or no channel has a known sign. See `expected_signs`.
    """
    order = boundary_order(measurement) if order is None else order
    if order is None:
        return None
    signs = expected_signs(measurement.protocol, order)
    known = np.asarray(measurement.mask) & (signs != 0)
    wrong = known & (np.sign(np.real(np.asarray(measurement.voltages))) == -signs)
    count = known.sum(axis=1)
    if not count.any():
        return None
    return wrong.sum(axis=1) / np.maximum(count, 1)


def boundary_order(measurement: Measurement) -> Int[np.ndarray, " L"] | None:
    """(L,) the electrodes as they follow each other along the outer edge, by their positions; None where they are not
    known to lie on it."""
    electrodes, domain = measurement.electrodes, measurement.domain
    if not isinstance(electrodes, BoundaryElectrodes) or domain is None:
        return None
    loops = domain.loops()
    if not loops:
        return None
    return np.argsort(along(np.asarray(electrodes.position), np.asarray(loops[0])), kind="stable")


def reciprocity_noise(measurement: Measurement, deviation: Float[np.ndarray, " M"]) -> float | None:
    """The noise of channels by reciprocity, in units of `deviation` (M,), their expected errors relative to each other;
    None where the protocol ties no two usable channels together. Robust, as `estimate_noise` is."""
    error, noise, _ = _asymmetry(measurement, deviation)
    return _robust_deviation(error / noise) if error.size else None


def _asymmetry(
    measurement: Measurement, deviation: np.ndarray | None = None
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Entries of T - Tᵀ (watts); what noise of such `deviation`, or of one volt per channel, adds to them; and what
    they are compared with: those entries of T and its diagonal, over that noise where `deviation` is given.

    With the currents that show a change best (`jeit.protocol.optimal`), the change lies in the diagonal alone.
    """
    protocol = measurement.protocol
    frames = np.unique(np.linspace(0, measurement.num_frames - 1, _MOST_FRAMES).round().astype(int))
    voltages = np.nan_to_num(np.asarray(measurement.voltages)[frames])
    masks = np.asarray(measurement.mask)[frames]
    parts = []
    for mask in np.unique(masks, axis=0):
        transfer, known, gain = transfer_between_drives(
            np.asarray(protocol.drive),
            np.asarray(protocol.measurement),
            np.asarray(protocol.drive_index),
            np.asarray(protocol.measurement_index),
            voltages[np.all(masks == mask, axis=1)],
            mask,
            deviation,
        )
        row, column = np.nonzero(np.triu(known & known.T, k=1))
        upper, lower = transfer[:, row, column], transfer[:, column, row]
        noise = np.hypot(gain[row, column], gain[column, row])
        size = np.sqrt((np.abs(upper) ** 2 + np.abs(lower) ** 2) / 2)
        own = np.flatnonzero(np.diag(known))
        # In ‖T‖² the diagonal is counted once, and each pair, here one entry, twice.
        diagonal = np.abs(transfer[:, own, own]) / np.sqrt(2)
        if deviation is not None:
            size, diagonal = size / noise, diagonal / (np.sqrt(2) * gain[own, own])
        parts.append((upper - lower, np.broadcast_to(noise, upper.shape), np.concatenate([size, diagonal], axis=1)))
    error, noise, signal = (np.concatenate([part[k].ravel() for part in parts]) for k in range(3))
    return error, noise, signal


def _robust_deviation(values: np.ndarray) -> float:
    if np.iscomplexobj(values):
        values = np.concatenate([np.real(values), np.imag(values)])
    return float(1.4826 * np.median(np.abs(values)))


# Electrodes that are listed, at most.
_MOST = 40
# Difference that noise alone makes to the share of impossible signs between two orders.
_CHANCE = 0.01


def order_note(measurement: Measurement) -> str | None:
    """A sentence on electrodes that are not numbered along the edge; None where they are, or do not lie on it."""
    order = boundary_order(measurement)
    if order is None or len(order) < 4 or follows(order):
        return None
    listed = ", ".join(str(number + 1) for number in _from_the_first(order)[:_MOST])
    more = " …" if len(order) > _MOST else ""
    note = f"going round the edge, the positions of the electrodes come in the order {listed}{more}"
    here, numbered = (impossible_signs(measurement, one) for one in (order, np.arange(len(order))))
    if here is None or numbered is None or abs(here.mean() - numbered.mean()) <= _CHANCE:
        return f"{note}. If they are not numbered so, rows of the positions are exchanged."
    if here.mean() < numbered.mean():
        return f"{note}; the signs of the voltages agree."
    return (
        f"{note}, and the voltages contradict it: {100 * here.mean():.0f} % of their signs are impossible at these "
        f"positions, {100 * numbered.mean():.0f} % if the electrodes followed each other by their numbers. Rows of the "
        "positions are exchanged: mend them, or every image is wrong."
    )


def follows(order: Int[np.ndarray, " L"]) -> bool:
    """Whether electrodes in this order go up, or down, by one all the way round."""
    steps = (np.roll(order, -1) - order) % len(order)
    return bool((steps == 1).all() or (steps == len(order) - 1).all())


def _from_the_first(order: Int[np.ndarray, " L"]) -> Int[np.ndarray, " L"]:
    """The order from the first electrode on, in the sense in which most numbers increase."""
    steps = (np.roll(order, -1) - order) % len(order)
    if (steps == len(order) - 1).sum() > (steps == 1).sum():
        order = order[::-1]
    return np.roll(order, -int(np.flatnonzero(order == 0)[0]))


# A quarter of the signs wrong means that half of the voltages are noise (noise is wrong half the time).
MOST_IMPOSSIBLE_SIGNS = 0.25
# Noise has as many right signs as wrong ones: so many wrong ones are not noise.
MOST_OPPOSITE_SIGNS = 0.75
# Reciprocity error r of a difference means noise over signal of r / sqrt(2 - r²): here a half.
MOST_DIFFERENCE_RECIPROCITY_ERROR = 0.63
# Cosine of a frame and its reference, below which one of them has the opposite sign.
_LEAST_COSINE = -0.5


@dataclass(frozen=True)
class FrameQuality:
    """Result of `assess` for one frame and its difference from the reference.

    - `difference`: ‖v - v_reference‖ / ‖v_reference‖ over usable channels.
    - `difference_noise`: noise of the difference in volts, and relative to it; None when it cannot be estimated.
    - `trusted_noise`: noise of the difference in units of `jeit.inverse.relative_noise` of the reference, the expected
      error of channels relative to each other; None when it cannot be estimated.
    - `difference_reciprocity_error`: relative reciprocity error of the difference, or None.
    - `impossible_signs`: the larger fraction, of frame and reference, of voltages of a sign that no passive
      body gives; or None.
    - `usable_channels`: channels usable in both.
    - `reason`: why the frame cannot be imaged; empty when it can.
    """

    difference: float
    difference_noise: NoiseEstimate | None
    trusted_noise: float | None
    difference_reciprocity_error: float | None
    impossible_signs: float | None
    usable_channels: int
    reason: str

    @property
    def imageable(self) -> bool:
        """True when nothing speaks against imaging the frame."""
        return not self.reason


def check_same_setup(measurement: Measurement, reference: Measurement) -> None:
    """Raise `ValueError` unless both were measured with the same electrodes, patterns, currents and unit."""
    ours, theirs = measurement.protocol, reference.protocol
    if ours.num_electrodes != theirs.num_electrodes:
        raise ValueError(
            f"'{measurement.name}' has {ours.num_electrodes} electrodes and the reference '{reference.name}' "
            f"{theirs.num_electrodes}: they are not of the same set-up. Give a reference from the same body."
        )
    if ours.num_measurements != theirs.num_measurements:
        raise ValueError(
            f"'{measurement.name}' has {ours.num_measurements} channels ({ours.name}) and the reference "
            f"'{reference.name}' {theirs.num_measurements} ({theirs.name}). Both must use one protocol."
        )
    if not ours.same_patterns(theirs):
        ratio = float(np.linalg.norm(ours.channel_drive) / np.linalg.norm(theirs.channel_drive))
        scaled = ratio * np.asarray(theirs.channel_drive)
        if np.allclose(ours.channel_drive, scaled, rtol=1e-6, atol=1e-12) and np.allclose(
            ours.channel_measurement, theirs.channel_measurement, rtol=1e-6
        ):
            raise ValueError(
                f"'{measurement.name}' was driven with {ratio:.4g} times the current of the reference "
                f"'{reference.name}'. Their difference would show the current, not the body: use a reference "
                "at the same current, or divide both by their currents first."
            )
        raise ValueError(
            f"'{measurement.name}' ({ours.name}) and the reference '{reference.name}' ({theirs.name}) drive "
            "or read different electrodes. Give a reference measured with the same protocol."
        )
    if np.iscomplexobj(measurement.voltages) != np.iscomplexobj(reference.voltages):
        raise ValueError(
            f"'{measurement.name}' and the reference '{reference.name}' are not both complex. Read both with "
            "the same component (real, imaginary, magnitude or complex)."
        )
    for one, prefix in ((measurement, ""), (reference, "the reference ")):
        if not np.asarray(one.mask).any():
            raise ValueError(
                f"{prefix}'{one.name}' has no usable voltage: each is NaN, infinite, or masked for what its notes say. "
                "Give another frame."
            )
    common = np.asarray(measurement.mask).any(axis=0) & np.asarray(reference.mask).any(axis=0)
    if not common.any():
        raise ValueError(f"'{measurement.name}' and the reference '{reference.name}' have no usable channel in common.")
    sizes = [np.median(np.abs(np.asarray(m.mean_frame().voltages)[0, common])) for m in (measurement, reference)]
    ratio = sizes[0] / sizes[1] if sizes[1] > 0 else np.inf
    if not 1 / 100 < ratio < 100:
        raise ValueError(
            f"The voltages of '{measurement.name}' are {ratio:.3g} times those of the reference "
            f"'{reference.name}': the two are in different units (volts and millivolts?) or at different "
            "gains. Give both in volts."
        )


def assess(measurement: Measurement, reference: Measurement) -> list[FrameQuality]:
    """Judge each frame of `measurement` for difference imaging against the mean of `reference`'s frames.

    A frame cannot be imaged when

    - it, or the reference, has an impossible sign in more than a quarter of its voltages
      (`impossible_signs`): half of the voltages or more then lie below the instrument's noise or offset;
    - it, or the reference, breaks reciprocity by more than 0.63, or the difference does: its noise is over half its
      signal, each channel trusted as images trust it (`jeit.inverse.relative_noise`): driven electrodes read large
      voltages, mostly of contacts;
    - its voltages are those of the reference with the opposite sign, nearly: their cosine is less than -0.5, and no
      change of a passive body turns all of them round;
    - it does not differ from the reference at all;
    - fewer channels than electrodes are usable.

    On the measured sets in reach, usable frames stay below 0.18 and 0.21; a frame measured at too small a
    current has 0.54 of its signs wrong.

    Raises `ValueError` when the two are not of one set-up (`check_same_setup`).
    """
    check_same_setup(measurement, reference)
    mean = reference.mean_frame()
    reference_signs, reference_error = impossible_signs(mean), reciprocity_error(mean)
    trusted = np.asarray(relative_noise(np.abs(np.asarray(mean.voltages)[0]), np.asarray(mean.mask)[0]))
    results = []
    for index in range(measurement.num_frames):
        frame = measurement.frame(index)
        both = np.asarray(frame.mask) & np.asarray(mean.mask)
        change = Measurement(
            np.where(both, np.asarray(frame.voltages) - np.asarray(mean.voltages), np.nan), both, measurement.protocol
        )
        size = float(np.linalg.norm(np.asarray(change.filled())))
        relative = size / float(np.linalg.norm(np.where(both, np.asarray(mean.filled()), 0)) or np.inf)
        signs = [float(s[0]) for s in (impossible_signs(frame), reference_signs) if s is not None]
        usable = int(both.sum())
        alike = _cosine(*(np.where(both, np.asarray(one.filled()), 0).ravel() for one in (frame, mean)))
        error = reciprocity_error(change, trusted) if usable and size > 0 else None
        own = {f"the reference '{reference.name}'": reference_error, "the frame": reciprocity_error(frame)}
        wrong = max(signs) if signs else None
        results.append(
            FrameQuality(
                difference=relative,
                difference_noise=estimate_noise(change) if usable and size > 0 else None,
                trusted_noise=reciprocity_noise(change, trusted) if usable and size > 0 else None,
                difference_reciprocity_error=error,
                impossible_signs=wrong,
                usable_channels=usable,
                reason=_reason(measurement.protocol.num_electrodes, usable, relative, wrong, error, own, alike),
            )
        )
    return results


def check_imageable(measurement: Measurement, reference: Measurement) -> list[FrameQuality]:
    """`assess(measurement, reference)`; raises `ValueError` with the reason for the first bad frame."""
    qualities = assess(measurement, reference)
    for index, quality in enumerate(qualities):
        if not quality.imageable:
            where = f", frame {index}" if measurement.num_frames > 1 else ""
            raise ValueError(f"'{measurement.name}'{where} cannot be imaged: {quality.reason}")
    return qualities


def _reason(
    electrodes: int,
    usable: int,
    difference: float,
    signs: float | None,
    reciprocity: float | None,
    own: dict[str, float | None],
    alike: float,
) -> str:
    """Why a frame cannot be imaged; `own`: the reciprocity errors of both frames themselves; `alike`: their cosine."""
    if usable < electrodes:
        return f"only {counted(usable, 'channel')} usable in both it and its reference, for {electrodes} electrodes."
    if difference < 1e-12:
        return "it equals its reference, so there is no difference to image. Is it the same file?"
    if signs is not None and signs > MOST_OPPOSITE_SIGNS:
        return (
            f"{percent(signs)} of the voltages have a sign that no passive body gives: reverse the polarity of it, or "
            "of its reference."
        )
    if signs is not None and signs > MOST_IMPOSSIBLE_SIGNS:
        return (
            f"too noisy: {percent(signs)} of the voltages have a sign that no passive body gives, so that "
            "more than half of them lie below the instrument's noise or offset. Measure with more current or gain."
        )
    if alike < _LEAST_COSINE:
        return (
            "its voltages have the opposite sign of its reference's: reverse the polarity of it, or of its reference."
        )
    for name, error in own.items():
        if error is not None and error > MOST_DIFFERENCE_RECIPROCITY_ERROR:
            return (
                f"{name} breaks reciprocity by {percent(error)} on its own: it is too noisy, or its channels are in "
                "another order than described. See `jeit info`."
            )
    if reciprocity is not None and reciprocity > MOST_DIFFERENCE_RECIPROCITY_ERROR:
        return (
            f"too noisy: the difference from the reference breaks reciprocity by {percent(reciprocity)}, "
            "so that its noise is more than half its signal. Average more frames, or use more current."
        )
    return ""


def _cosine(one: np.ndarray, other: np.ndarray) -> float:
    """Cosine of the angle between two frames, 1 where they are alike but for their size; 0 where one is zero."""
    size = float(np.linalg.norm(one) * np.linalg.norm(other))
    return float(np.real(np.vdot(one, other))) / size if size > 0 else 0.0
