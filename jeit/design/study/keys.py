"""The keys of a study file: what each may hold, and how a wrong one is told."""

import math
from collections.abc import Iterable
from typing import Any, NamedTuple

from jeit.arguments import did_you_mean
from jeit.design import defaults
from jeit.design.skin.protocol import PROTOCOLS


class Quantity(NamedTuple):
    """A number from `low` to `high`; `swept`: a list of them will do as well; `default` None: must be given."""

    low: float
    high: float
    default: float | None
    swept: bool = False
    whole: bool = False

    def read(self, where: str, value: Any) -> list:
        """The numbers that `value` holds: one, unless swept. Raises `ValueError`."""
        return [self._one(where, item) for item in _items(where, value, self.swept)]

    def _one(self, where: str, value: Any) -> float:
        wanted = "a whole number" if self.whole else "a number"
        right = isinstance(value, int) if self.whole else isinstance(value, (int, float))
        if isinstance(value, bool) or not right or not math.isfinite(value):
            raise ValueError(f"{where} must be {wanted}{' or a list of them' * self.swept}; it has {value!r}.")
        if not self.low <= value <= self.high:
            raise ValueError(
                f"{where} is {value:g}, and must be from {self.low:g} to {self.high:g}.{self._hint(where, value)}"
            )
        return value

    def _hint(self, where: str, value: float) -> str:
        if self.whole:
            return ""
        for factor, metric in ((1000, "metres"), (1e-3, "micrometres")):
            if self.low <= factor * value <= self.high:
                other = f"in {metric}" if where.endswith("_mm") else "off by a factor of 1000"
                return f" Is it {other}? Then write {factor * value:g}."
        return ""


class Words(NamedTuple):
    """Text, one of `choices` if there are any; `swept`: a list will do as well; `default` None: must be given."""

    choices: tuple[str, ...]
    default: Any
    swept: bool = False

    def read(self, where: str, value: Any) -> list[str]:
        """The words that `value` holds: one, unless swept. Raises `ValueError`."""
        items = _items(where, value, self.swept)
        for item in items:
            if not isinstance(item, str) or not item:
                raise ValueError(f"{where} must be text in quotes{' or a list of it' * self.swept}; it has {item!r}.")
            if self.choices and item not in self.choices:
                raise ValueError(
                    f"{where} has no {item!r}{did_you_mean(item, self.choices)}; take {', '.join(self.choices)}."
                )
        return items


class Flag(NamedTuple):
    """true or false."""

    default: bool
    swept: bool = False

    def read(self, where: str, value: Any) -> list[bool]:
        """The flag, as a list of one. Raises `ValueError`."""
        [item] = _items(where, value, swept=False)
        if not isinstance(item, bool):
            raise ValueError(f"{where} must be true or false, without quotes; it has {item!r}.")
        return [item]


# Of linear changes of a sheet's voltages, with a prior: see `jeit.design.layout_scores`.
OPTIMALITY = ("information", "mean_variance", "largest_variance", "localisation_error")
SCORES = ("minimum", "mean", "uniformity", "blind_spot", "taxels", *OPTIMALITY)

_Key = Quantity | Words | Flag
_TOP: dict[str, _Key] = {
    "name": Words((), "study"),
    "chunk_points": Quantity(1, 4096, 16, whole=True),
}
_SECTIONS: dict[str, dict[str, _Key]] = {
    "skin": {
        "model": Words(("sheet", "layer"), "sheet"),
        "width_mm": Quantity(5, 5000, 1e3 * defaults.SIDE),
        "height_mm": Quantity(5, 5000, 1e3 * defaults.SIDE),
        "thickness_mm": Quantity(0.05, 200, 1e3 * defaults.THICKNESS, swept=True),
        "conductivity_S_per_m": Quantity(1e-6, 1e8, defaults.CONDUCTIVITY, swept=True),
    },
    "electrodes": {
        "layouts": Words((), None, swept=True),
        "diameter_mm": Quantity(0.1, 200, math.nan, swept=True),
        "contact_impedance_ohm_m2": Quantity(1e-9, 1e3, math.nan, swept=True),
        "minimum_gap_mm": Quantity(0, 1000, 0),
    },
    "measurement": {
        "protocol": Words(PROTOCOLS, defaults.PROTOCOL, swept=True),
        "pairs": Quantity(0, 523_776, math.nan, swept=True, whole=True),
        "current_mA": Quantity(1e-4, 1e3, 1e3 * defaults.CURRENT),
        "noise_V": Quantity(1e-12, 1, defaults.NOISE, swept=True),
    },
    "touch": {
        "indentation": Words(("bell", "hemisphere"), "bell"),
        "depth_mm": Quantity(0.01, 100, 1e3 * defaults.DEPTH),
        "deviation_mm": Quantity(0.1, 200, 1e3 * defaults.DEVIATION),
        "diameter_mm": Quantity(0.1, 200, 1e3 * defaults.BALL_DIAMETER),
        "contrast": Quantity(0, defaults.MOST_CONTRAST, defaults.CONTRAST),
        "exact": Flag(False),
        "columns": Quantity(1, 1000, defaults.STUDY_PLACES, whole=True),
        "rows": Quantity(1, 1000, defaults.STUDY_PLACES, whole=True),
    },
    "mesh": {
        "cell_mm": Quantity(0.1, 200, 1e3 * defaults.CELL_SIZE, swept=True),
        "layers": Quantity(1, 50, defaults.NUM_LAYERS, whole=True),
    },
    "scores": {
        "wanted": Words(SCORES, ["minimum", "mean", "uniformity"], swept=True),
        "num_taxels": Quantity(1, 10_000, defaults.NUM_TAXELS, whole=True),
        "threshold": Quantity(0.01, 0.99, defaults.THRESHOLD),
        "correlation_mm": Quantity(0.1, 1000, 1e3 * defaults.CORRELATION),
        "seed": Quantity(0, 2**31 - 1, 0, whole=True),
    },
}
# Keys without effect unless another has one of these words.
_NEEDS: dict[str, tuple[str, tuple[str, ...]]] = {
    "mesh.layers": ("skin.model", ("layer",)),
    "touch.deviation_mm": ("touch.indentation", ("bell",)),
    "touch.diameter_mm": ("touch.indentation", ("hemisphere",)),
    "measurement.pairs": ("measurement.protocol", ("two-terminal",)),
    "measurement.noise_V": ("scores.wanted", ("blind_spot", *OPTIMALITY)),
    "scores.num_taxels": ("scores.wanted", ("taxels",)),
    "scores.threshold": ("scores.wanted", ("taxels",)),
    "scores.seed": ("scores.wanted", ("taxels",)),
    "scores.correlation_mm": ("scores.wanted", ("information", "mean_variance", "largest_variance")),
}


def read_keys(table: dict[str, Any]) -> dict[str, Any]:
    """Every key's value, by its dotted name: lists where the key may be swept, defaults where it is missing.

    A default of NaN is for the layout to say. Raises `ValueError` naming the key and what to do, also for a key that
    has no effect beside the others.
    """
    _refuse_unknown("", table, [*_TOP, *_SECTIONS])
    values = _section("", table, _TOP)
    for name, keys in _SECTIONS.items():
        section = table.get(name, {})
        if not isinstance(section, dict):
            raise ValueError(f"{name} must be a table: a line [{name}], and its keys below.")
        _refuse_unknown(f"{name}.", section, keys)
        values |= _section(f"{name}.", section, keys)
    one_side = {"width_mm", "height_mm"} & set(table.get("skin", {}))
    if len(one_side) == 1:
        raise ValueError(f"skin.{one_side.pop()} is given alone; give both skin.width_mm and skin.height_mm.")
    _refuse_idle(table, values)
    return values


def _section(prefix: str, table: dict[str, Any], keys: dict[str, _Key]) -> dict[str, Any]:
    values = {}
    for name, key in keys.items():
        if name in table:
            items = key.read(prefix + name, table[name])
        elif key.default is None:
            raise ValueError(f"{prefix}{name} is missing; give it.")
        else:
            items = key.default if isinstance(key.default, list) else [key.default]
        values[prefix + name] = items if key.swept else items[0]
    return values


def _refuse_unknown(prefix: str, table: dict[str, Any], known: Iterable[str]) -> None:
    known = list(known)
    for name in table:
        if name not in known:
            raise ValueError(
                f"{prefix}{name} is no key of a study{did_you_mean(name, known)}; there are {', '.join(known)}."
            )


def _refuse_idle(table: dict[str, Any], values: dict[str, Any]) -> None:
    for where, (other, words) in _NEEDS.items():
        section, name = where.split(".")
        there = values[other] if isinstance(values[other], list) else [values[other]]
        if name in table.get(section, {}) and not set(words) & set(there):
            raise ValueError(
                f"{where} has no effect: it applies where {other} is {' or '.join(map(repr, words))}, and that is "
                f"{', '.join(map(repr, there))}; leave it out, or change the other."
            )


def _items(where: str, value: Any, swept: bool) -> list:
    if not isinstance(value, list):
        return [value]
    if not swept:
        raise ValueError(f"{where} takes one value, not a list: it cannot be swept.")
    if not value:
        raise ValueError(f"{where} is an empty list; give one value at least.")
    if any(value.count(item) > 1 for item in value):
        raise ValueError(f"{where} lists a value twice; give each once.")
    return value
