"""Detection of wiring errors: exchanged wires, channels in the wrong order, and voltages of opposite sign.

`exchanges_message` detects drives or measurements that are exchanged in a frame but not in its reference. If each drive
has all measurements, frame and reference are matrices (drives, measurements), and an exchange of two drives exchanges
two rows. The exchanges that make the frame most similar to its reference are determined.

`find_wiring` estimates the wiring that explains a frame of the empty body. A uniform body is known except for its
conductivity and its contacts. Its transfer impedance Z (L, L) is computed for several contact impedances; if electrode
k is at the place of electrode p(k), the transfer impedance is Z[p, p]. Wirings are compared by their misfit to the
frame, up to a scale factor.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from itertools import combinations

import numpy as np
from jaxtyping import Float, Inexact, Int

from jeit.arguments import percent
from jeit.data import Measurement
from jeit.forward import ForwardModel
from jeit.forward.model import select_channels
from jeit.protocol import Protocol
from jeit_solvers.engines import on_host

# Maximum ratio of the difference between frame and reference after an exchange to the difference before, for each
# exchange and for all reported exchanges together; and maximum number of exchanges.
_MAX_DIFFERENCE_RATIO_PER_EXCHANGE, _MAX_DIFFERENCE_RATIO, _MAX_ROW_EXCHANGES = 0.9, 0.5, 4


def exchanges_message(frame: Measurement, reference: Measurement) -> str:
    """Describe in a sentence which drives, or which measurements of every drive, seem exchanged in a frame, numbered
    from 1. The sentence is empty if no exchanges halve the frame's difference from the reference, or if not all drives
    have the same measurements."""
    channel_matrix = _channel_matrix(frame)
    if channel_matrix is None:
        return ""
    usable_channels = (np.asarray(frame.mask)[0] & np.asarray(reference.mask)[0])[channel_matrix]
    frame_values, reference_values = (
        np.where(usable_channels, np.asarray(measurement.filled())[0][channel_matrix], 0)
        for measurement in (frame, reference)
    )
    difference_norm = float(np.linalg.norm(frame_values - reference_values))
    exchange_candidates = [
        (*_best_row_exchanges(frame_values, reference_values), "drives"),
        (*_best_row_exchanges(frame_values.T, reference_values.T), "measurements of every drive"),
    ]
    remaining_norm, exchanged_pairs, kind_of_exchange = min(exchange_candidates, key=lambda candidate: candidate[0])
    if not exchanged_pairs or remaining_norm > _MAX_DIFFERENCE_RATIO * difference_norm:
        return ""
    reference_norm = float(np.linalg.norm(reference_values))
    pair_text = ", ".join(f"{first_row + 1} and {second_row + 1}" for first_row, second_row in exchanged_pairs)
    return (
        f"{kind_of_exchange} {pair_text} look exchanged in it, and not in its reference: so taken it differs from that "
        f"by {percent(remaining_norm / reference_norm)}, as it is by {percent(difference_norm / reference_norm)}. Mend "
        "its order; or go on as it is (as_is=True, --as-is)."
    )


def _channel_matrix(frame: Measurement) -> np.ndarray | None:
    """Return the index of the channel of each drive and measurement pattern, (drives, measurements); None if a drive
    lacks a measurement."""
    drive_index, measurement_index = (
        np.asarray(pattern_index) for pattern_index in (frame.protocol.drive_index, frame.protocol.measurement_index)
    )
    matrix_shape = int(drive_index.max()) + 1, int(measurement_index.max()) + 1
    channel_matrix = np.full(matrix_shape, -1)
    channel_matrix[drive_index, measurement_index] = np.arange(len(drive_index))
    return None if (channel_matrix < 0).any() else channel_matrix


def _best_row_exchanges(
    frame_rows: Inexact[np.ndarray, "n k"], reference_rows: Inexact[np.ndarray, "n k"]
) -> tuple[float, list[tuple[int, int]]]:
    """Norm of the difference between two matrices after exchanges of rows, and the exchanges, most effective first."""
    squared_norms = np.sum(np.abs(frame_rows) ** 2, axis=1)[:, None] + np.sum(np.abs(reference_rows) ** 2, axis=1)
    squared_distances: Float[np.ndarray, "n n"] = np.maximum(
        squared_norms - 2 * np.real(frame_rows @ reference_rows.conj().T), 0
    )
    squared_difference, exchanged_rows = float(np.trace(squared_distances)), []
    for _ in range(_MAX_ROW_EXCHANGES):
        diagonal_distances = np.diag(squared_distances)
        squared_reduction = diagonal_distances[:, None] + diagonal_distances - squared_distances - squared_distances.T
        first_row, second_row = np.unravel_index(np.argmax(squared_reduction), squared_reduction.shape)
        if (
            squared_difference - squared_reduction[first_row, second_row]
            > _MAX_DIFFERENCE_RATIO_PER_EXCHANGE**2 * squared_difference
        ):
            break
        squared_difference = max(squared_difference - float(squared_reduction[first_row, second_row]), 0.0)
        exchanged_rows.append((int(min(first_row, second_row)), int(max(first_row, second_row))))
        squared_distances[[first_row, second_row]] = squared_distances[[second_row, first_row]]
    return float(np.sqrt(squared_difference)), exchanged_rows


MAX_WIRING_MISFIT = 0.15
"""Relative misfit of a uniform body to a frame of the empty body above which a wiring error is suspected."""
# Maximum ratio of the misfit with a changed wiring to the misfit before the change: for each exchange, and for the
# reported wiring relative to the described wiring.
_MAX_MISFIT_RATIO_PER_EXCHANGE, _MAX_WIRING_MISFIT_RATIO = 0.85, 0.6
_MAX_ELECTRODE_EXCHANGES = 4
# Relative misfit of the empty body above which imaging is refused even if no other wiring explains the frame.
_MAX_EMPTY_BODY_MISFIT = 0.5
# Trial contact impedances, multiplied by the conductivity and divided by the size of the body: from negligible to
# dominant.
_RELATIVE_CONTACT_IMPEDANCES = (1e-4, 1e-3, 1e-2, 1e-1, 1.0)


@dataclass(frozen=True)
class Wiring:
    """Estimated connection of electrodes and channels, which may differ from the described one, that of the data's
    description.

    - `places`: electrode k is at the place of electrode `places[k]`, numbered from 0.
    - `order`: order of the channels, a name in `channel_orders`; empty for the described order.
    - `reversed_signs`: whether all voltages have the opposite sign.
    - `magnitudes`: whether the voltages seem to have lost their signs.
    - `misfit`: relative misfit of a uniform body with this wiring to the frame; `described`: relative misfit with the
      described wiring.
    """

    places: tuple[int, ...]
    order: str = ""
    reversed_signs: bool = False
    magnitudes: bool = False
    misfit: float = field(default=np.inf, compare=False)
    described: float = field(default=np.inf, compare=False)

    @property
    def is_described_wiring(self) -> bool:
        """Whether the wiring is the described one."""
        return not (self.order or self.reversed_signs or self.magnitudes or self._exchange_cycles())

    @property
    def fault(self) -> str:
        """The fault of the wiring, in a sentence; empty if the wiring has no fault that prevents imaging."""
        if self.explanation or self.described < _MAX_EMPTY_BODY_MISFIT:
            return self.explanation
        return (
            f"the model misses {percent(self.described)} of it, and no order of channels, sign, or exchange of a few "
            "electrodes explains it: are geometry, electrodes, protocol and the order of the channels as described?"
        )

    @property
    def explanation(self) -> str:
        """The estimated wiring, in a sentence, with electrodes numbered from 1; empty for the described wiring."""
        wiring_faults = [_exchange_text(self.places, self._exchange_cycles())]
        wiring_faults.append(self.order and f"the channels look ordered {self.order}")
        wiring_faults.append(
            'all voltages look to have the opposite sign ([data] polarity = "reversed")' if self.reversed_signs else ""
        )
        wiring_faults.append("the voltages look to be magnitudes, without signs" if self.magnitudes else "")
        faults_text = ", and ".join(wiring_fault for wiring_fault in wiring_faults if wiring_fault)
        return (
            faults_text
            and f"{faults_text}: so taken the misfit is {percent(self.misfit)}, as described {percent(self.described)}."
        )

    def _exchange_cycles(self) -> list[list[int]]:
        """Cycles of the permutation of electrodes: each electrode is at the place of the next in its cycle."""
        cycles, moved_electrodes = [], {k for k, electrode in enumerate(self.places) if electrode != k}
        while moved_electrodes:
            cycle = [min(moved_electrodes)]
            while self.places[cycle[-1]] != cycle[0]:
                cycle.append(self.places[cycle[-1]])
            moved_electrodes -= set(cycle)
            cycles.append(cycle)
        return cycles


def find_wiring(
    model: ForwardModel, measurement: Measurement, impedances: Sequence[Float[np.ndarray, "L L"]] | None = None
) -> Wiring:
    """Find the wiring that explains the first frame of `measurement`, a frame of the empty body. The result is the
    described wiring unless a different wiring has a far smaller misfit.

    Candidates are other orders of the channels, voltages of opposite sign, other first electrodes, the reverse order of
    electrodes, and up to four successive exchanges of two electrodes. Voltages may be magnitudes if all have one sign,
    or if their signs are those that the described wiring implies. Such voltages are also compared by magnitude, and the
    result is used if it fits the frame better. Errors that leave the voltages unchanged, such as a rotation of the
    electrodes of a symmetric body, cannot be found.

    `impedances`: those of the model (see `uniform_impedances`), which are the same for all protocols; computed here if
    not given.
    """
    num_electrodes, orders_by_name = model.protocol.num_electrodes, channel_orders(model.protocol)
    described_wiring = Wiring(tuple(range(num_electrodes)))
    if not np.any(np.asarray(measurement.filled())[0]):
        return replace(
            described_wiring, misfit=1.0, described=0.0
        )  # a frame without signal does not determine the wiring
    impedances = uniform_impedances(model) if impedances is None else impedances
    protocol = on_host(model.protocol)
    compute_misfit = _create_misfit_function(protocol, impedances, measurement, orders_by_name)
    compared_wiring = compute_misfit(described_wiring)
    described_misfit = 1.0 if compared_wiring.reversed_signs else compared_wiring.misfit
    if compared_wiring.misfit < MAX_WIRING_MISFIT:  # as described, except possibly for the sign
        return replace(compared_wiring, described=described_misfit)
    best_wiring = _better_wiring(compute_misfit, described_wiring, compared_wiring, orders_by_name)
    expected_voltages = np.asarray(select_channels(protocol, impedances[0]))
    if (has_one_sign := _has_one_sign(expected_voltages, measurement)) is not None:
        compute_misfit = _create_misfit_function(
            protocol, impedances, measurement, orders_by_name, compares_signs=False
        )
        unsigned_wiring = _better_wiring(
            compute_misfit, described_wiring, compute_misfit(described_wiring), orders_by_name
        )
        if unsigned_wiring.misfit < _MAX_MISFIT_RATIO_PER_EXCHANGE * best_wiring.misfit:
            best_wiring = replace(unsigned_wiring, magnitudes=has_one_sign)
    best_wiring = (
        replace(described_wiring, misfit=described_misfit)
        if best_wiring.misfit > _MAX_WIRING_MISFIT_RATIO * described_misfit
        else best_wiring
    )
    return replace(best_wiring, described=described_misfit)


def _better_wiring(
    compute_misfit: Callable[[Wiring], Wiring],
    described_wiring: Wiring,
    best_wiring: Wiring,
    order_names: Iterable[str],
) -> Wiring:
    """Return the wiring that explains a frame far better than `best_wiring`, the described wiring with its misfit, or
    `best_wiring` if no wiring does."""
    num_electrodes = len(described_wiring.places)

    def choose_best_wiring(wirings: Iterable[Wiring], previous_wiring: Wiring) -> Wiring:
        # Misfits are rounded so that the first of equivalent wirings is chosen, for example of orders that are
        # equivalent by reciprocity.
        best_wiring = min((compute_misfit(wiring) for wiring in wirings), key=lambda wiring: round(wiring.misfit, 9))
        return (
            best_wiring
            if best_wiring.misfit < _MAX_MISFIT_RATIO_PER_EXCHANGE * previous_wiring.misfit
            else previous_wiring
        )

    def improve_by_exchanges(best_wiring: Wiring) -> Wiring:
        for _ in range(_MAX_ELECTRODE_EXCHANGES):
            electrode_pairs = combinations(range(num_electrodes), 2)
            previous_wiring = best_wiring
            best_wiring = choose_best_wiring(
                [
                    replace(best_wiring, places=_exchange_places(best_wiring.places, *electrode_pair))
                    for electrode_pair in electrode_pairs
                ],
                best_wiring,
            )
            if best_wiring is previous_wiring:
                break
        return best_wiring

    best_wiring = improve_by_exchanges(
        choose_best_wiring([replace(described_wiring, order=order_name) for order_name in order_names], best_wiring)
    )
    rotated_wirings = [
        Wiring(places, order_name) for places in _rotated_places(num_electrodes) for order_name in order_names
    ]
    return choose_best_wiring(
        [improve_by_exchanges(choose_best_wiring(rotated_wirings, compute_misfit(described_wiring)))], best_wiring
    )


def _has_one_sign(expected_voltages: Float[np.ndarray, " M"], measurement: Measurement) -> bool | None:
    """True if all voltages have one sign; False if all signs equal, or all oppose, those of the `expected_voltages` of
    a uniform body with the described wiring (which are assigned to magnitudes when their file is read); None for other
    signs."""
    is_used = np.asarray(measurement.mask)[0]
    voltage_signs = np.sign(np.real(np.asarray(measurement.filled())[0]))[is_used]
    if abs(voltage_signs.sum()) == np.count_nonzero(voltage_signs):
        return True
    sign_products = voltage_signs * np.sign(expected_voltages)[is_used]
    return False if (sign_products >= 0).all() or (sign_products <= 0).all() else None


def channel_orders(protocol: Protocol) -> dict[str, Int[np.ndarray, " M"]]:
    """Possible orders of the channels in a file, by name: index in the file (M,) of each channel of the protocol. The
    first order has an empty name and is that of the protocol."""
    drive_of_channel, measurement_of_channel = np.asarray(protocol.drive_index), np.asarray(protocol.measurement_index)
    channel_numbers = np.arange(len(drive_of_channel))
    positive_electrodes = np.asarray(protocol.measurement).argmax(axis=1)[measurement_of_channel]
    source_electrode, sink_electrode = (
        extreme_index(np.asarray(protocol.drive), axis=1)[drive_of_channel] for extreme_index in (np.argmax, np.argmin)
    )
    sort_keys = {
        'from electrode 1 on in every drive (order = "fixed")': (positive_electrodes, drive_of_channel),
        'from the driven electrodes on in every drive (order = "rotating")': (
            (positive_electrodes - source_electrode) % protocol.num_electrodes,
            drive_of_channel,
        ),
        "from the second driven electrode on in every drive (rotating)": (
            (positive_electrodes - sink_electrode) % protocol.num_electrodes,
            drive_of_channel,
        ),
        "measurement by measurement, not drive by drive": (drive_of_channel, positive_electrodes),
    }
    orders_by_name = {"": channel_numbers}
    for order_name, order_keys in sort_keys.items():
        channel_order = np.empty_like(channel_numbers)
        channel_order[np.lexsort(order_keys)] = channel_numbers
        if not any(np.array_equal(channel_order, known_order) for known_order in orders_by_name.values()):
            orders_by_name[order_name] = channel_order
    return orders_by_name


def _create_misfit_function(
    protocol: Protocol,
    impedances: Sequence[Float[np.ndarray, "L L"]],
    measurement: Measurement,
    orders_by_name,
    *,
    compares_signs: bool = True,
) -> Callable[[Wiring], Wiring]:
    """Return a function that computes the misfit of a wiring to the first frame of `measurement`, and the sign of the
    voltages. If `compares_signs` is False, only magnitudes of voltages are compared."""
    measured_voltages, usable_channels = np.real(np.asarray(measurement.filled())[0]), np.asarray(measurement.mask)[0]
    measured_voltages = measured_voltages if compares_signs else np.abs(measured_voltages)

    stacked_impedances = np.stack([np.asarray(transfer_impedance) for transfer_impedance in impedances])

    def compute_misfit(wiring: Wiring) -> Wiring:
        electrode_places, channel_order = np.array(wiring.places), orders_by_name[wiring.order]
        reordered_voltages, is_used_channel = measured_voltages[channel_order], usable_channels[channel_order]
        exchanged_impedances = stacked_impedances[:, electrode_places[:, None], electrode_places]
        expected_voltages = np.where(
            is_used_channel,
            [select_channels(protocol, transfer_impedance) for transfer_impedance in exchanged_impedances],
            0,
        )
        expected_voltages = expected_voltages if compares_signs else np.abs(expected_voltages)
        scale_factors = expected_voltages @ reordered_voltages / np.sum(expected_voltages**2, axis=1)
        residual_norms = np.linalg.norm(reordered_voltages - scale_factors[:, None] * expected_voltages, axis=1)
        best_impedance = int(np.argmin(residual_norms))
        misfit = float(residual_norms[best_impedance] / np.linalg.norm(reordered_voltages))
        return replace(wiring, misfit=misfit, reversed_signs=bool(scale_factors[best_impedance] < 0))

    return compute_misfit


def uniform_impedances(model: ForwardModel) -> list[Float[np.ndarray, "L L"]]:
    """Transfer impedances of the uniform body of unit conductivity, for each contact impedance of
    `_RELATIVE_CONTACT_IMPEDANCES`."""
    electrodes = model.electrodes
    if electrodes.is_point:
        return [np.asarray(model.transfer_impedance(1.0))]
    body_size = np.ptp(np.asarray(model.mesh.points), axis=0).max()
    relative_contact_impedances = np.asarray(electrodes.contact_impedance) / np.mean(electrodes.contact_impedance)
    models_by_contact = (
        model.with_electrodes(
            electrodes.with_contact_impedance(trial_impedance * body_size * relative_contact_impedances)
        )
        for trial_impedance in _RELATIVE_CONTACT_IMPEDANCES
    )
    return [np.asarray(model.transfer_impedance(1.0)) for model in models_by_contact]


def _rotated_places(num_electrodes: int) -> Iterator[tuple[int, ...]]:
    """Yield the places of electrodes that are counted from any first electrode in either direction, except in the
    described order."""
    for shift in range(num_electrodes):
        for direction in (1, -1):
            if (shift, direction) != (0, 1):
                yield tuple((shift + direction * k) % num_electrodes for k in range(num_electrodes))


def _exchange_places(places: tuple[int, ...], first_electrode: int, second_electrode: int) -> tuple[int, ...]:
    new_places = list(places)
    new_places[first_electrode], new_places[second_electrode] = (
        new_places[second_electrode],
        new_places[first_electrode],
    )
    return tuple(new_places)


def _exchange_text(places: tuple[int, ...], exchange_cycles: list[list[int]]) -> str:
    """Description of exchanged electrodes, in words."""
    if exchange_cycles and places in _rotated_places(len(places)):
        counting_direction = "from another one" if (places[1] - places[0]) % len(places) == 1 else "the other way round"
        first_electrode_text = f", electrode 1 standing where {places[0] + 1} should" if places[0] else ""
        return f"the electrodes look counted {counting_direction}{first_electrode_text}"
    exchanged_pairs = [
        f"{first_electrode + 1} and {second_electrode + 1}"
        for first_electrode, second_electrode in (cycle for cycle in exchange_cycles if len(cycle) == 2)
    ]
    exchange_texts = [f"electrodes {', '.join(exchanged_pairs)} look exchanged"] if exchanged_pairs else []
    exchange_texts += [
        f"electrodes {' → '.join(str(k + 1) for k in [*cycle, cycle[0]])} each look as if they stood where the next "
        "one should"
        for cycle in exchange_cycles
        if len(cycle) > 2
    ]
    return ", and ".join(exchange_texts)


def check_wiring(wiring: Wiring, reference: Measurement, as_is: bool) -> None:
    """Check the `wiring` estimated from `reference`. Raises `ValueError` if it differs from the description or explains
    the reference too poorly (see `Wiring.fault`), unless `as_is`."""
    if wiring.fault and not as_is:
        # Voltages of the opposite sign cannot be calibrated, even with `as_is`.
        suggested_remedy = "" if wiring.reversed_signs else "; or go on as it is (as_is=True, --as-is)"
        raise ValueError(
            f"'{reference.name}' does not fit its description: {wiring.fault} Mend the wires or the description"
            f"{suggested_remedy}."
        )
