"""A skin as a TOML file says: its layout, material, protocol and mesh."""

import math
import tomllib
from pathlib import Path
from typing import Any

from jeit.arguments import did_you_mean
from jeit.design import defaults
from jeit.design.skin.protocol import PROTOCOLS, skin_protocol
from jeit.design.skin.skin import Skin
from jeit.design.study.keys import Quantity, Words
from jeit.design.study.layouts import study_layout
from jeit.mesh import Rectangle

_KEYS: dict[str, dict[str, Quantity | Words]] = {
    "skin": {
        "model": Words(("sheet", "layer"), "sheet"),
        "width_mm": Quantity(5, 5000, 1e3 * defaults.SIDE),
        "height_mm": Quantity(5, 5000, 1e3 * defaults.SIDE),
        "thickness_mm": Quantity(0.05, 200, 1e3 * defaults.THICKNESS),
        "conductivity_S_per_m": Quantity(1e-6, 1e8, defaults.CONDUCTIVITY),
    },
    "electrodes": {
        "layout": Words((), None),
        "diameter_mm": Quantity(0.1, 200, math.nan),
        "contact_impedance_ohm_m2": Quantity(1e-9, 1e3, math.nan),
    },
    "measurement": {
        "protocol": Words(PROTOCOLS, defaults.PROTOCOL),
        "pairs": Quantity(0, 523_776, math.nan, whole=True),
        "current_mA": Quantity(1e-4, 1e3, 1e3 * defaults.CURRENT),
    },
    "mesh": {
        "cell_mm": Quantity(0.1, 200, 1e3 * defaults.CELL_SIZE),
        "layers": Quantity(1, 50, defaults.NUM_LAYERS, whole=True),
    },
}


def describes_skin(path: str | Path) -> bool:
    """True for a TOML file with a table "skin", whatever else is wrong with it; False for any other file."""
    try:
        return isinstance(tomllib.loads(Path(path).read_text("utf-8")).get("skin"), dict)
    except (OSError, ValueError):
        return False


def read_described_skin(path: str | Path) -> Skin:
    """The skin that a TOML file describes: tables skin, electrodes (with `layout`, a name or a file beside it),
    measurement and mesh, as in a study file, each key with one value and all but the layout with a default.

    Raises `FileNotFoundError`, and `ValueError` for files that are no TOML, keys and values that there are not, and as
    `Skin.create` does.
    """
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"'{path}': there is no such file.")
    try:
        table = tomllib.loads(path.read_text("utf-8"))
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise ValueError(f"'{path}' is no TOML file: {error}") from None
    try:
        return _made(_values(table), path.parent)
    except ValueError as error:
        raise ValueError(f"'{path}': {error}") from None


def _values(table: dict[str, Any]) -> dict[str, Any]:
    """Every key's value, by its dotted name."""
    values = {}
    for name in table:
        if name not in _KEYS:
            raise ValueError(f"{name} is no table of a skin{did_you_mean(name, _KEYS)}; there are {', '.join(_KEYS)}.")
    for section, keys in _KEYS.items():
        given = table.get(section, {})
        if not isinstance(given, dict):
            raise ValueError(f"{section} must be a table: a line [{section}], and its keys below.")
        for name in given:
            if name not in keys:
                near = did_you_mean(name, keys)
                raise ValueError(f"{section}.{name} is no key of a skin{near}; there are {', '.join(keys)}.")
        for name, key in keys.items():
            where = f"{section}.{name}"
            if name not in given and key.default is None:
                raise ValueError(f"{where} is missing; give it, such as 'park-inner'.")
            values[where] = key.read(where, given[name])[0] if name in given else key.default
    return values


def _made(values: dict[str, Any], folder: Path) -> Skin:
    outline = Rectangle(1e-3 * values["skin.width_mm"], 1e-3 * values["skin.height_mm"])
    diameter, impedance = 1e-3 * values["electrodes.diameter_mm"], values["electrodes.contact_impedance_ohm_m2"]
    layout = study_layout(values["electrodes.layout"], folder, outline, diameter, impedance, 0.0)
    pairs = values["measurement.pairs"]
    number = None if isinstance(pairs, float) else pairs
    current = 1e-3 * values["measurement.current_mA"]
    return Skin.create(
        layout,
        thickness=1e-3 * values["skin.thickness_mm"],
        conductivity=values["skin.conductivity_S_per_m"],
        num_layers=values["mesh.layers"] if values["skin.model"] == "layer" else 0,
        cell_size=1e-3 * values["mesh.cell_mm"],
        protocol=skin_protocol(layout, values["measurement.protocol"], num_pairs=number, current=current),
    )
