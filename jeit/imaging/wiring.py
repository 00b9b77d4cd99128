"""Detection of wiring errors: exchanged wires, channels in another order, and voltages of opposite sign.

`exchanges_message` detects drives or measurements that are exchanged in a frame but not in its reference. If each drive
has all measurements, frame and reference are matrices (drives, measurements), and an exchange of two drives exchanges
two rows. The exchanges that make the frame most similar to its reference are found.

`find_wiring` finds the wiring that explains a frame of the empty body. A uniform body is known except for its
conductivity and its contacts. Its transfer impedance Z (L, L) is computed for several contact impedances; if electrode
k is at the place of electrode p(k), it is Z[p, p]. Wirings are compared by their misfit to the frame, with a free
scale.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
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

# Maximum ratio of the difference after an exchange to that before, for each exchange and for all reported exchanges
# together; and maximum number of exchanges.
_EXCHANGE_STEP, _EXCHANGE_BETTER, _MOST = 0.9, 0.5, 4


def exchanges_message(frame: Measurement, reference: Measurement) -> str:
    """Sentence that names the drives, or the measurements of every drive, that seem exchanged in a frame, numbered from
    1; empty if no exchanges halve its difference from the reference, or if not all drives have the same
    measurements."""
    order = _order(frame)
    if order is None:
        return ""
    both = (np.asarray(frame.mask)[0] & np.asarray(reference.mask)[0])[order]
    measured, rest = (np.where(both, np.asarray(one.filled())[0][order], 0) for one in (frame, reference))
    described = float(np.linalg.norm(measured - rest))
    found = [
        (*_exchanges(measured, rest), "drives"),
        (*_exchanges(measured.T, rest.T), "measurements of every drive"),
    ]
    left, pairs, what = min(found, key=lambda one: one[0])
    if not pairs or left > _EXCHANGE_BETTER * described:
        return ""
    size = float(np.linalg.norm(rest))
    named = ", ".join(f"{one + 1} and {other + 1}" for one, other in pairs)
    return (
        f"{what} {named} look exchanged in it, and not in its reference: so taken it differs from that by "
        f"{percent(left / size)}, as it is by {percent(described / size)}. Mend its order; or go on as it is "
        "(as_is=True, --as-is)."
    )


def _order(frame: Measurement) -> np.ndarray | None:
    """Index of the channel of each drive and measurement, (drives, measurements); None if a drive lacks a
    measurement."""
    drive, reading = (np.asarray(one) for one in (frame.protocol.drive_index, frame.protocol.measurement_index))
    shape = int(drive.max()) + 1, int(reading.max()) + 1
    order = np.full(shape, -1)
    order[drive, reading] = np.arange(len(drive))
    return None if (order < 0).any() else order


def _exchanges(
    measured: Inexact[np.ndarray, "n k"], rest: Inexact[np.ndarray, "n k"]
) -> tuple[float, list[tuple[int, int]]]:
    """Norm of the difference between two matrices after exchanges of rows, and the exchanges, most effective first."""
    square = np.sum(np.abs(measured) ** 2, axis=1)[:, None] + np.sum(np.abs(rest) ** 2, axis=1)
    apart: Float[np.ndarray, "n n"] = np.maximum(square - 2 * np.real(measured @ rest.conj().T), 0)
    left, pairs = float(np.trace(apart)), []
    for _ in range(_MOST):
        own = np.diag(apart)
        gain = own[:, None] + own - apart - apart.T
        one, other = np.unravel_index(np.argmax(gain), gain.shape)
        if left - gain[one, other] > _EXCHANGE_STEP**2 * left:
            break
        left = max(left - float(gain[one, other]), 0.0)
        pairs.append((int(min(one, other)), int(max(one, other))))
        apart[[one, other]] = apart[[other, one]]
    return float(np.sqrt(left)), pairs


MOST_MISFIT = 0.15
"""Relative misfit of the empty body above which a wiring error is suspected."""
# Maximum ratio of the misfit with another wiring to that before: for each exchange, and for the wiring reported.
_STEP, _BETTER = 0.85, 0.6
_MOST_EXCHANGES = 4
# Relative misfit of the empty body above which imaging is refused even if no other wiring explains the frame.
_HOPELESS = 0.5
# Contact impedance times conductivity, divided by the size of the body: from negligible to dominant.
_CONTACTS = (1e-4, 1e-3, 1e-2, 1e-1, 1.0)


@dataclass(frozen=True)
class Wiring:
    """Estimated connection of electrodes and channels.

    - `places`: electrode k is at the place of electrode `places[k]`, numbered from 0.
    - `order`: order of the channels, a name in `channel_orders`; empty if as described.
    - `reversed_signs`: whether all voltages have the opposite sign.
    - `magnitudes`: whether the voltages look to have lost their signs.
    - `misfit`: relative misfit of a uniform body with this wiring to the frame; `described`: with the described wiring.
    """

    places: tuple[int, ...]
    order: str = ""
    reversed_signs: bool = False
    magnitudes: bool = False
    misfit: float = field(default=np.inf, compare=False)
    described: float = field(default=np.inf, compare=False)

    @property
    def as_described(self) -> bool:
        """Whether the wiring is the described one."""
        return not (self.order or self.reversed_signs or self.magnitudes or self._cycles())

    @property
    def fault(self) -> str:
        """The fault of the wiring, in a sentence; empty if it has none that prevents imaging."""
        if self.explanation or self.described < _HOPELESS:
            return self.explanation
        return (
            f"the model misses {percent(self.described)} of it, and no order of channels, sign, or exchange of a few "
            "electrodes explains it: are geometry, electrodes, protocol and the order of the channels as described?"
        )

    @property
    def explanation(self) -> str:
        """The wiring found, in a sentence, with electrodes numbered from 1; empty if it is the described one."""
        found = [_exchanged_places(self.places, self._cycles())]
        found.append(self.order and f"the channels look ordered {self.order}")
        found.append(
            'all voltages look to have the opposite sign ([data] polarity = "reversed")' if self.reversed_signs else ""
        )
        found.append("the voltages look to be magnitudes, without signs" if self.magnitudes else "")
        said = ", and ".join(one for one in found if one)
        return (
            said and f"{said}: so taken the misfit is {percent(self.misfit)}, as described {percent(self.described)}."
        )

    def _cycles(self) -> list[list[int]]:
        """Cycles of the permutation of electrodes: each electrode is at the place of the next in its cycle."""
        cycles, left = [], {k for k, place in enumerate(self.places) if place != k}
        while left:
            cycle = [min(left)]
            while self.places[cycle[-1]] != cycle[0]:
                cycle.append(self.places[cycle[-1]])
            left -= set(cycle)
            cycles.append(cycle)
        return cycles


def find_wiring(model: ForwardModel, measurement: Measurement) -> Wiring:
    """Find the wiring that explains the first frame of `measurement`, of the empty body: the described wiring, unless
    the misfit of another is far smaller.

    Candidates are other orders of the channels, voltages of opposite sign, other first electrodes, the reverse order of
    electrodes, and up to four successive exchanges of two electrodes. Voltages all of one sign, or with the signs that
    the described wiring gives them, may be magnitudes: they are compared without signs if that explains more. Errors
    that leave the voltages unchanged, such as a rotation of the electrodes of a symmetric body, cannot be found.
    """
    count, orders = model.protocol.num_electrodes, channel_orders(model.protocol)
    plain = Wiring(tuple(range(count)))
    if not np.any(np.asarray(measurement.filled())[0]):
        return replace(plain, misfit=1.0, described=0.0)  # a frame without signal does not determine the wiring
    misfit_of = _comparison(model, measurement, orders)
    best = misfit_of(plain)
    described = 1.0 if best.reversed_signs else best.misfit
    if best.misfit < MOST_MISFIT:  # as described, except possibly for the sign
        return replace(best, described=described)
    found = _explained(misfit_of, plain, best, orders)
    if (one_way := _signs_say_nothing(model, measurement)) is not None:
        misfit_of = _comparison(model, measurement, orders, signs=False)
        without = _explained(misfit_of, plain, misfit_of(plain), orders)
        if without.misfit < _STEP * found.misfit:
            found = replace(without, magnitudes=one_way)
    found = replace(plain, misfit=described) if found.misfit > _BETTER * described else found
    return replace(found, described=described)


def _explained(misfit_of: Callable[[Wiring], Wiring], plain: Wiring, best: Wiring, orders: Iterable[str]) -> Wiring:
    """The wiring that explains a frame far better than `best`, the described one, or that."""
    count = len(plain.places)

    def least(tried: Iterable[Wiring], so_far: Wiring) -> Wiring:
        # Misfits are rounded so that the first of equivalent wirings is taken, such as orders that are the same by
        # reciprocity.
        best = min((misfit_of(one) for one in tried), key=lambda one: round(one.misfit, 9))
        return best if best.misfit < _STEP * so_far.misfit else so_far

    def with_exchanges(best: Wiring) -> Wiring:
        for _ in range(_MOST_EXCHANGES):
            pairs = combinations(range(count), 2)
            so_far = best
            best = least([replace(best, places=_exchanged(best.places, *pair)) for pair in pairs], best)
            if best is so_far:
                break
        return best

    best = with_exchanges(least([replace(plain, order=order) for order in orders], best))
    turned = [Wiring(places, order) for places in _turns(count) for order in orders]
    return least([with_exchanges(least(turned, misfit_of(plain)))], best)


def _signs_say_nothing(model: ForwardModel, measurement: Measurement) -> bool | None:
    """Whether all voltages have one sign; False if they have the signs of a uniform body with the described wiring, as
    magnitudes are given on reading; None if neither."""
    used = np.asarray(measurement.mask)[0]
    signs = np.sign(np.real(np.asarray(measurement.filled())[0]))[used]
    expected = np.sign(select_channels(on_host(model.protocol), _impedances(model)[0]))[used]
    if abs(signs.sum()) == np.count_nonzero(signs):
        return True
    return False if (signs * expected >= 0).all() or (signs * expected <= 0).all() else None


def channel_orders(protocol: Protocol) -> dict[str, Int[np.ndarray, " M"]]:
    """Possible orders of the channels in a file, by name: index in the file (M,) of each channel of the protocol. The
    first has an empty name and is the order of the protocol."""
    drive, measurement = np.asarray(protocol.drive_index), np.asarray(protocol.measurement_index)
    channels = np.arange(len(drive))
    first = np.asarray(protocol.measurement).argmax(axis=1)[measurement]
    source, sink = (choose(np.asarray(protocol.drive), axis=1)[drive] for choose in (np.argmax, np.argmin))
    ways = {
        'from electrode 1 on in every drive (order = "fixed")': (first, drive),
        'from the driven electrodes on in every drive (order = "rotating")': (
            (first - source) % protocol.num_electrodes,
            drive,
        ),
        "from the second driven electrode on in every drive (rotating)": (
            (first - sink) % protocol.num_electrodes,
            drive,
        ),
        "measurement by measurement, not drive by drive": (drive, first),
    }
    orders = {"": channels}
    for name, keys in ways.items():
        order = np.empty_like(channels)
        order[np.lexsort(keys)] = channels
        if not any(np.array_equal(order, known) for known in orders.values()):
            orders[name] = order
    return orders


def _comparison(
    model: ForwardModel, measurement: Measurement, orders, *, signs: bool = True
) -> Callable[[Wiring], Wiring]:
    """Function that computes the misfit of a wiring and the sign of its voltages; of their magnitudes without
    `signs`."""
    protocol = on_host(model.protocol)
    voltages, mask = np.real(np.asarray(measurement.filled())[0]), np.asarray(measurement.mask)[0]
    impedances, voltages = _impedances(model), voltages if signs else np.abs(voltages)

    def misfit_of(wiring: Wiring) -> Wiring:
        places, order = np.array(wiring.places), orders[wiring.order]
        measured, used = voltages[order], mask[order]
        size, best = np.linalg.norm(measured), wiring
        for impedance in impedances:
            expected = np.where(used, select_channels(protocol, impedance[np.ix_(places, places)]), 0)
            expected = expected if signs else np.abs(expected)
            scale = expected @ measured / (expected @ expected)
            misfit = float(np.linalg.norm(measured - scale * expected) / size)
            if misfit < best.misfit or best is wiring:
                best = replace(wiring, misfit=misfit, reversed_signs=bool(scale < 0))
        return best

    return misfit_of


def _impedances(model: ForwardModel) -> list[Float[np.ndarray, "L L"]]:
    """Transfer impedances of the uniform body of unit conductivity, for each contact impedance of `_CONTACTS`."""
    electrodes = model.electrodes
    if electrodes.is_point:
        return [np.asarray(model.transfer_impedance(1.0))]
    size = np.ptp(np.asarray(model.mesh.points), axis=0).max()
    relative = np.asarray(electrodes.contact_impedance) / np.mean(electrodes.contact_impedance)
    models = (model.with_electrodes(electrodes.with_contact_impedance(one * size * relative)) for one in _CONTACTS)
    return [np.asarray(one.transfer_impedance(1.0)) for one in models]


def _turns(count: int) -> Iterator[tuple[int, ...]]:
    """Places of electrodes for each other first electrode, and for the reverse order."""
    for shift in range(count):
        for way in (1, -1):
            if (shift, way) != (0, 1):
                yield tuple((shift + way * k) % count for k in range(count))


def _exchanged(places: tuple[int, ...], first: int, second: int) -> tuple[int, ...]:
    changed = list(places)
    changed[first], changed[second] = changed[second], changed[first]
    return tuple(changed)


def _exchanged_places(places: tuple[int, ...], cycles: list[list[int]]) -> str:
    """Description of exchanged electrodes, in words."""
    if cycles and places in _turns(len(places)):
        way = "from another one" if (places[1] - places[0]) % len(places) == 1 else "the other way round"
        first = f", electrode 1 standing where {places[0] + 1} should" if places[0] else ""
        return f"the electrodes look counted {way}{first}"
    pairs = [f"{first + 1} and {second + 1}" for first, second in (one for one in cycles if len(one) == 2)]
    found = [f"electrodes {', '.join(pairs)} look exchanged"] if pairs else []
    found += [
        f"electrodes {' → '.join(str(k + 1) for k in [*cycle, cycle[0]])} each look as if they stood where the next "
        "one should"
        for cycle in cycles
        if len(cycle) > 2
    ]
    return ", and ".join(found)
