"""Quality of measurements, judged from the voltages alone, without a model of the body.

Criteria are reciprocity, noise, signs that no passive body can produce, and the order of electrodes along an edge.

Electrodes may be numbered in any order. A numbering that does not follow the edge is nevertheless reported, because two
exchanged rows in a table of positions spoil every image without being noticed. The report adds whether the signs of the
voltages, which depend on the order, agree with the numbering.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from jeit.data.measurement import Measurement
from jeit.electrodes import BoundaryElectrodes
from jeit.mesh.topology import project_to_loop
from jeit.protocol import Protocol
from jeit.protocol.reciprocity import transfer_between_drives

# Maximum number of frames from which a recording is judged; longer recordings are sampled evenly.
_MAX_ASSESSED_FRAMES = 32
# Detection of rounding: largest number of significant digits, relative accuracy of multiples of a step (single
# precision), and smallest number of voltages that can show rounding.
_MAX_SIGNIFICANT_DIGITS, _RELATIVE_STEP_ACCURACY, _MIN_VOLTAGES_FOR_ROUNDING_STEP = 5, 1e-6, 16


@dataclass(frozen=True)
class NoiseEstimate:
    """Estimate of the noise in a single voltage.

    **Fields**

    - `standard_deviation`: standard deviation (root mean square) in volts.
    - `relative`: standard deviation divided by the root mean square of the usable voltages.
    - `method`: "reciprocity" or "repeated frames".

    **Example:**

    ```python
    noise = estimate_noise(pressed)
    noise.standard_deviation, noise.method
    ```
    """

    standard_deviation: float
    relative: float
    method: str


def reciprocity_error(measurement: Measurement, deviation: Float[np.ndarray, " M"] | None = None) -> float | None:
    """Relative deviation from reciprocity: ‖T - Tᵀ‖ / ‖T‖ for the matrix T of transfer between drives; None if no two
    usable channels are related by reciprocity.

    T_ij is the voltage that drive pattern i would read as a measurement pattern while drive j flows, combined from the
    measured channels (see `jeit.protocol.reciprocity.transfer_between_drives`). T is symmetric for every body, so an
    asymmetry is due to noise, drift, gain errors, or a wrong protocol. Independent noise of relative size ε yields an
    error of about √2 ε.

    **Arguments:**

    - `measurement`: the frames.
    - `deviation` (channels,): expected errors of the channels, relative to each other; the entries of T are divided by
      their expected errors, which follow from `deviation`. By default all channels are weighted equally.

    **Example:**

    ```python
    error = reciprocity_error(pressed)
    ```
    """
    error, noise, signal_entries = _transfer_asymmetry(measurement, deviation)
    if error.size == 0:
        return None
    if deviation is not None:
        error = error / noise
    signal_norm = np.linalg.norm(signal_entries)
    return float(np.linalg.norm(error) / signal_norm) if signal_norm > 0 else 0.0


def channel_reciprocity_error(measurement: Measurement) -> Float[np.ndarray, "F M"]:
    """Each voltage (frames, channels) minus the value predicted by its reciprocal channel, in volts; NaN for channels
    without a reciprocal channel.

    **Arguments:**

    - `measurement`: the frames.

    **Example:**

    ```python
    deviation = channel_reciprocity_error(pressed)
    ```
    """
    reciprocal_pairs, voltage_ratios = measurement.protocol.reciprocal_pairs()
    voltages, usable_mask = np.asarray(measurement.voltages), np.asarray(measurement.mask)
    channel_errors = np.full(voltages.shape, np.nan, dtype=voltages.dtype)
    if len(reciprocal_pairs) == 0:
        return np.abs(channel_errors)
    first_channels, second_channels = reciprocal_pairs.T
    usable_pairs = usable_mask[:, first_channels] & usable_mask[:, second_channels]
    error = voltages[:, first_channels] - voltages[:, second_channels] / voltage_ratios
    channel_errors[:, first_channels] = np.where(usable_pairs, error, np.nan)
    channel_errors[:, second_channels] = np.where(usable_pairs, -error * voltage_ratios, np.nan)
    return np.real(channel_errors) if np.isrealobj(voltages) else np.abs(channel_errors)


def estimate_noise(measurement: Measurement) -> NoiseEstimate | None:
    """Estimate the noise of a single voltage from reciprocity, or else from repeated frames; None without reciprocal
    channels and repeated frames.

    - Reciprocity: two channels that must be equal differ by √2 standard deviations of the noise; combinations of
      channels that must be equal are treated in the same way. The estimate includes drift and gain errors, which cancel
      in a difference of two frames: to obtain the noise of a difference, pass the difference as the measurement.
    - Repeated frames (8 or more, without frame names): differences of successive frames.

    The estimate is 1.4826 times the median absolute difference; it is robust against outliers in up to half of the
    channels.

    **Arguments:**

    - `measurement`: the frames.

    **Example:**

    ```python
    noise = estimate_noise(pressed)
    ```
    """
    voltages, usable_mask = np.asarray(measurement.voltages), np.asarray(measurement.mask)
    rms_voltage = float(np.sqrt(np.mean(np.abs(voltages[usable_mask]) ** 2))) if usable_mask.any() else 0.0
    error, noise_gain, _ = _transfer_asymmetry(measurement)
    if error.size:
        noise_deviation = _robust_deviation(error / noise_gain)
        method_name = "reciprocity"
    elif measurement.num_frames >= 8 and not measurement.frame_names:
        frame_steps = np.diff(voltages, axis=0)[usable_mask[1:] & usable_mask[:-1]]
        noise_deviation = _robust_deviation(frame_steps / np.sqrt(2)) if frame_steps.size else 0.0
        method_name = "repeated frames"
    else:
        return None
    return NoiseEstimate(
        noise_deviation, noise_deviation / rms_voltage if rms_voltage > 0 else float("inf"), method_name
    )


def expected_signs(protocol: Protocol, electrode_order: Int[np.ndarray, " L"]) -> Int[np.ndarray, " M"]:
    """Sign (M,) that the voltage of each of the M channels has on every passive body; 0 if the sign depends on the
    body.

    On the boundary of a simply connected sheet the potential falls monotonically from source to sink along both arcs
    between them: a local extremum elsewhere would contradict the maximum principle, for any (positive) conductivity.
    The sign of a voltage between two electrodes of the same arc is therefore known. `electrode_order` (L,) lists the L
    electrodes as they follow each other along the boundary. The sign is 0 for channels that do not drive and measure by
    pairs of electrodes.
    """
    num_electrodes = protocol.num_electrodes
    rank_of_electrode = np.empty(num_electrodes, dtype=int)
    rank_of_electrode[electrode_order] = np.arange(len(electrode_order))
    channel_drives, channel_measurements = np.asarray(protocol.channel_drive), np.asarray(protocol.channel_measurement)
    is_pair_of_electrodes = (np.count_nonzero(channel_drives, axis=1) == 2) & (
        np.count_nonzero(channel_measurements, axis=1) == 2
    )
    source_ranks = rank_of_electrode[channel_drives.argmax(axis=1)]
    # Ranks are positions along the boundary counted from the source: the potential falls from rank 0 to sink, and rises
    # from sink to num_electrodes.
    sink_rank = (rank_of_electrode[channel_drives.argmin(axis=1)] - source_ranks) % num_electrodes
    positive_rank = (rank_of_electrode[channel_measurements.argmax(axis=1)] - source_ranks) % num_electrodes
    negative_rank = (rank_of_electrode[channel_measurements.argmin(axis=1)] - source_ranks) % num_electrodes
    is_falling = (positive_rank <= sink_rank) & (negative_rank <= sink_rank)
    voltage_signs = np.where(is_falling, np.sign(negative_rank - positive_rank), 0)
    positive_rank, negative_rank = (
        np.where(positive_rank == 0, num_electrodes, positive_rank),
        np.where(negative_rank == 0, num_electrodes, negative_rank),
    )
    is_rising = (positive_rank >= sink_rank) & (negative_rank >= sink_rank) & ~is_falling
    return np.where(
        is_pair_of_electrodes, np.where(is_rising, np.sign(positive_rank - negative_rank), voltage_signs), 0
    )


def impossible_signs(
    measurement: Measurement, order: Int[np.ndarray, " L"] | None = None
) -> Float[np.ndarray, " F"] | None:
    """Fraction of the usable voltages of each frame whose sign is impossible on a passive body.

    The sign of a complex voltage is the sign of its real part. Voltages that are pure noise have the wrong sign half of
    the time, so the fraction of noisy channels is about twice the returned fraction. Returns None if the electrodes are
    not known to lie along the boundary of an outline, or if no channel has a known sign. See `expected_signs`.

    **Arguments:**

    - `measurement`: the frames.
    - `order` (electrodes,): the electrodes as they follow each other along the boundary; by default the order is
      computed from the positions of the electrodes.

    **Example:**

    ```python
    share = impossible_signs(pressed)
    ```
    """
    order = boundary_order(measurement) if order is None else order
    if order is None:
        return None
    expected_sign = expected_signs(measurement.protocol, order)
    has_known_sign = np.asarray(measurement.mask) & (expected_sign != 0)
    has_wrong_sign = has_known_sign & (np.sign(np.real(np.asarray(measurement.voltages))) == -expected_sign)
    num_known = has_known_sign.sum(axis=1)
    if not num_known.any():
        return None
    return has_wrong_sign.sum(axis=1) / np.maximum(num_known, 1)


def boundary_order(measurement: Measurement) -> Int[np.ndarray, " L"] | None:
    """Indices (electrodes,) of the electrodes in their order along the outer edge of the body; None if they are not
    known to lie on the edge."""
    electrodes, body_domain = measurement.electrodes, measurement.domain
    if not isinstance(electrodes, BoundaryElectrodes) or body_domain is None:
        return None
    boundary_loops = body_domain.loops()
    if not boundary_loops:
        return None
    return np.argsort(project_to_loop(np.asarray(electrodes.position), np.asarray(boundary_loops[0])), kind="stable")


def reciprocity_noise(measurement: Measurement, deviation: Float[np.ndarray, " M"]) -> float | None:
    """Noise of the channels estimated from reciprocity, in units of `deviation` (channels,), the expected errors of
    channels relative to each other. The estimator is as robust as `estimate_noise`. None if no two usable channels are
    related by reciprocity."""
    error, noise, _ = _transfer_asymmetry(measurement, deviation)
    return _robust_deviation(error / noise) if error.size else None


def signal_evidence(measurement: Measurement, deviation: Float[np.ndarray, " M"]) -> float | None:
    """Evidence that a difference of two frames contains more than noise, in standard deviations of what noise alone
    would yield; None if no two usable channels are related by reciprocity.

    Of the matrix T of transfer between drives (see `reciprocity_error`), T - Tᵀ contains only noise, T + Tᵀ noise and
    signal. For noise alone the power of both is equal, up to a relative deviation of about 2 / √N for N pairs of
    entries. The evidence grows with N, so it may be large where noise exceeds the signal in every single channel.

    **Arguments:**

    - `measurement`: the difference of two frames.
    - `deviation` (channels,): expected errors of the channels, relative to each other.

    **Example:**

    ```python
    evidence = signal_evidence(difference, relative_noise(voltages))
    ```
    """
    error, noise, signal_entries = _transfer_asymmetry(measurement, deviation)
    if error.size == 0:
        return None
    # An entry of `signal_entries` off the diagonal counts two entries of T, an entry of the diagonal half as much.
    num_pairs, num_diagonal = error.size, signal_entries.size - error.size
    noise_power = float(np.mean(np.abs(error / noise) ** 2)) * (num_pairs / 2 + num_diagonal / 4)
    signal_power = float(np.sum(signal_entries**2))
    return (signal_power / noise_power - 1) * np.sqrt(num_pairs) if noise_power > 0 else np.inf


def rounding_deviation(voltages: Float[np.ndarray, " M"], mask: Bool[np.ndarray, " M"]) -> Float[np.ndarray, " M"]:
    """Standard deviation (channels,) of the rounding errors of voltages, in volts; zero if no rounding is found.

    Voltages may be rounded to a number of significant digits, or to multiples of a step, such as that of a converter.
    The coarsest rounding that agrees with all usable voltages is assumed; the rounding error is uniform within ± half a
    step. Reciprocal voltages are rounded in the same way, so reciprocity does not show the rounding error.
    """
    voltage_magnitudes, mask = np.abs(np.real(np.asarray(voltages))), np.asarray(mask)
    positive_magnitudes = voltage_magnitudes[mask & (voltage_magnitudes > 0)]
    if len(positive_magnitudes) < _MIN_VOLTAGES_FOR_ROUNDING_STEP:
        return np.zeros(len(voltage_magnitudes))
    bounded_magnitudes = np.where(
        mask, np.maximum(voltage_magnitudes, positive_magnitudes.min()), positive_magnitudes.min()
    )
    candidate_steps = [
        10.0 ** (np.floor(np.log10(bounded_magnitudes) + _RELATIVE_STEP_ACCURACY) - num_digits)
        for num_digits in range(_MAX_SIGNIFICANT_DIGITS)
    ]
    value_gaps = np.diff(np.unique(np.append(0, positive_magnitudes)))
    smallest_gap = value_gaps[value_gaps > _RELATIVE_STEP_ACCURACY * positive_magnitudes.max()].min()
    candidate_steps += [np.full(len(voltage_magnitudes), smallest_gap / gap_divisor) for gap_divisor in (1, 2, 3)]
    matching_steps = [
        candidate_step
        for candidate_step in candidate_steps
        if _are_multiples(voltage_magnitudes[mask], candidate_step[mask])
    ]
    coarsest_step = max(
        matching_steps,
        key=lambda candidate_step: float(np.log(candidate_step[mask]).sum()),
        default=np.zeros(len(voltage_magnitudes)),
    )
    return coarsest_step / np.sqrt(12)


def _are_multiples(voltage_magnitudes: np.ndarray, rounding_step: np.ndarray) -> bool:
    """Whether each value is a multiple of its step, with a quotient of at most `_MAX_SIGNIFICANT_DIGITS` digits."""
    step_quotients = voltage_magnitudes / rounding_step
    step_remainders = np.abs(step_quotients - np.round(step_quotients))
    return bool(
        (step_quotients < 10**_MAX_SIGNIFICANT_DIGITS).all()
        and (step_remainders <= _RELATIVE_STEP_ACCURACY * np.maximum(step_quotients, 1)).all()
    )


def _transfer_asymmetry(
    measurement: Measurement, voltage_deviation: np.ndarray | None = None
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Asymmetry of the matrix T of transfer between drives (`reciprocity_error`). Returns the entries of T - Tᵀ
    (watts), their standard deviation for noise of the given `voltage_deviation` (default: one volt per channel), and
    the entries of T with its diagonal, to which the asymmetry is compared. The entries of T are divided by their noise
    if `voltage_deviation` is specified.

    The diagonal is included because for the optimal currents of `jeit.protocol.optimal` a change of the body alters
    only the diagonal.
    """
    protocol = measurement.protocol
    frames = np.unique(np.linspace(0, measurement.num_frames - 1, _MAX_ASSESSED_FRAMES).round().astype(int))
    voltages = np.nan_to_num(np.asarray(measurement.voltages)[frames])
    frame_masks = np.asarray(measurement.mask)[frames]

    mask_results = []
    for frame_mask in np.unique(frame_masks, axis=0):
        drive_transfer, is_known, noise_gain = transfer_between_drives(
            np.asarray(protocol.drive),
            np.asarray(protocol.measurement),
            np.asarray(protocol.drive_index),
            np.asarray(protocol.measurement_index),
            voltages[np.all(frame_masks == frame_mask, axis=1)],
            frame_mask,
            voltage_deviation,
        )
        first_drives, second_drives = np.nonzero(np.triu(is_known & is_known.T, k=1))
        upper_entries, lower_entries = (
            drive_transfer[:, first_drives, second_drives],
            drive_transfer[:, second_drives, first_drives],
        )
        noise = np.hypot(noise_gain[first_drives, second_drives], noise_gain[second_drives, first_drives])
        entry_sizes = np.sqrt((np.abs(upper_entries) ** 2 + np.abs(lower_entries) ** 2) / 2)
        diagonal_drives = np.flatnonzero(np.diag(is_known))
        # In ‖T‖² a diagonal entry counts once; a pair of off-diagonal entries, which is one entry here, counts twice.
        diagonal_entries = np.abs(drive_transfer[:, diagonal_drives, diagonal_drives]) / np.sqrt(2)
        if voltage_deviation is not None:
            entry_sizes, diagonal_entries = (
                entry_sizes / noise,
                diagonal_entries / (np.sqrt(2) * noise_gain[diagonal_drives, diagonal_drives]),
            )
        mask_results.append(
            (
                upper_entries - lower_entries,
                np.broadcast_to(noise, upper_entries.shape),
                np.concatenate([entry_sizes, diagonal_entries], axis=1),
            )
        )
    error, noise, signal_entries = (
        np.concatenate([result_arrays[k].ravel() for result_arrays in mask_results]) for k in range(3)
    )
    return error, noise, signal_entries


def _robust_deviation(values: np.ndarray) -> float:
    if np.iscomplexobj(values):
        values = np.concatenate([np.real(values), np.imag(values)])
    return float(1.4826 * np.median(np.abs(values)))


# Maximum number of electrodes that a note lists.
_MAX_LISTED_ELECTRODES = 40
# Maximum difference, between two orders of electrodes, of the fractions of impossible signs that can be due to noise.
_MAX_CHANCE_DIFFERENCE = 0.01


def describe_electrode_order(measurement: Measurement) -> str | None:
    """A sentence that reports that electrodes are not numbered in their order along the edge; None if they are, or if
    they do not lie on an edge."""
    edge_order = boundary_order(measurement)
    if edge_order is None or len(edge_order) < 4 or is_cyclic_sequence(edge_order):
        return None
    electrode_list = ", ".join(
        str(electrode_number + 1) for electrode_number in _rotate_to_first(edge_order)[:_MAX_LISTED_ELECTRODES]
    )
    ellipsis_text = " …" if len(edge_order) > _MAX_LISTED_ELECTRODES else ""
    order_text = (
        f"going round the edge, the positions of the electrodes come in the order {electrode_list}{ellipsis_text}"
    )
    position_signs, number_signs = (
        impossible_signs(measurement, electrode_order) for electrode_order in (edge_order, np.arange(len(edge_order)))
    )
    if (
        position_signs is None
        or number_signs is None
        or abs(position_signs.mean() - number_signs.mean()) <= _MAX_CHANCE_DIFFERENCE
    ):
        return f"{order_text}. If they are not numbered so, rows of the positions are exchanged."
    if position_signs.mean() < number_signs.mean():
        return f"{order_text}; the signs of the voltages agree."
    return (
        f"{order_text}, and the voltages contradict it: {100 * position_signs.mean():.0f} % of their signs are "
        f"impossible at these positions, {100 * number_signs.mean():.0f} % if the electrodes followed each other by "
        "their numbers. Rows of the positions are exchanged: mend them, or every image is wrong."
    )


def is_cyclic_sequence(electrode_order: Int[np.ndarray, " L"]) -> bool:
    """Whether the electrode numbers in the cyclic `electrode_order` increase by one at every step, or decrease by
    one."""
    number_steps = (np.roll(electrode_order, -1) - electrode_order) % len(electrode_order)
    return bool((number_steps == 1).all() or (number_steps == len(electrode_order) - 1).all())


def _rotate_to_first(electrode_order: Int[np.ndarray, " L"]) -> Int[np.ndarray, " L"]:
    """The cyclic `electrode_order` of electrodes rotated to begin at the first electrode, in the direction in which
    most numbers increase."""
    number_steps = (np.roll(electrode_order, -1) - electrode_order) % len(electrode_order)
    if (number_steps == len(electrode_order) - 1).sum() > (number_steps == 1).sum():
        electrode_order = electrode_order[::-1]
    return np.roll(electrode_order, -int(np.flatnonzero(electrode_order == 0)[0]))
