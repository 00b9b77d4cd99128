"""Folders of results, and descriptions of measurements, bodies and electrodes for reports."""

from __future__ import annotations

import csv
import json
import math
import tempfile
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from importlib import metadata
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from jeit.data import Measurement
from jeit.electrodes import AbstractElectrodes
from jeit.files import atomically_written_files
from jeit.inverse import DetectableDiameters
from jeit.mesh import Body

if TYPE_CHECKING:
    from jeit.imaging import ImagedDifference

# Error handler of `str.encode` for characters that cannot be encoded, such as invalid bytes in the names of files.
_ENCODING_ERRORS = "backslashreplace"


@contextmanager
def results(folder: str | Path, names: tuple[str, ...]) -> Iterator[Path]:
    """Context manager that yields a temporary folder for files with the given `names`. When all files are written, they
    are moved to `folder` together; `folder` is created if needed. Raises `ValueError` if the path `folder` cannot be a
    folder."""
    with atomically_written_files(results_folder(folder, names)) as temporary_folder:
        yield temporary_folder


def write_json(report: dict[str, Any], path: Path) -> None:
    """Write a report of plain numbers, strings, lists and dictionaries as JSON."""
    json_text = json.dumps(report, indent=2, ensure_ascii=False, allow_nan=False)
    path.write_text(json_text + "\n", "utf-8", errors=_ENCODING_ERRORS)


def write_rows(path: Path, columns: Sequence[str], rows: Iterable[Iterable[Any]]) -> None:
    """Write a table as CSV, with the names of its `columns` in the first line."""
    with path.open("w", newline="", encoding="utf-8", errors=_ENCODING_ERRORS) as file:
        csv_writer = csv.writer(file)
        csv_writer.writerow(columns)
        csv_writer.writerows(rows)


def results_folder(folder: str | Path, names: tuple[str, ...]) -> Path:
    """Check that files with the given `names` can be written to the folder, and create it if needed. Raises
    `ValueError` if the folder cannot be written to, or contains a folder with one of these names."""
    path = Path(folder)
    if path.exists() and not path.is_dir():
        raise ValueError(f"folder {path} is a file; give a folder for the results.")
    try:
        path.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=path):
            pass
        folder_names = [name for name in names if (path / name).is_dir()]
    except OSError as error:
        reason = error.strerror or error
        raise ValueError(f"folder {path} cannot be written to ({reason}); give another folder.") from None
    if folder_names:
        raise ValueError(f"folder {path}: there is a folder named {folder_names[0]} in it; give another.")
    return path


def describe_measurement(measurement: Measurement) -> dict[str, Any]:
    """Describe a measurement by its name, source, number of channels and notes."""
    mask = np.asarray(measurement.mask)
    return {
        "name": measurement.name,
        "source": measurement.source,
        "frame": measurement.frame_names[0] if len(measurement.frame_names) == 1 else None,
        "channels": measurement.num_channels,
        "masked": int((~mask).sum()),
        "notes": list(measurement.notes),
    }


def describe_domain(domain: Body | None) -> dict[str, Any]:
    """Describe a body by its shape and its size in metres."""
    return {"shape": "not known"} if domain is None else {**domain.describe(), "unit": "m"}


def describe_electrodes(electrodes: AbstractElectrodes | None) -> dict[str, Any]:
    """Describe electrodes by their kind and number, and by their positions and sizes in metres."""
    if electrodes is None:
        return {"kind": "at places not known"}
    return to_plain_values(electrodes.describe())


def describe_detectable(diameters: DetectableDiameters, limited_by: str) -> dict[str, Any]:
    """Describe the smallest insulating bodies that can be detected by their diameters in metres, which are None if they
    exceed the domain, and by what they are `limited_by`, such as the noise."""
    return {
        "diameter_in_half_of_the_domain": diameters.median,
        "diameter_almost_everywhere": diameters.almost_everywhere,
        "unit": "m",
        "limited_by": limited_by,
    }


def describe_detectable_in_image(imaged: "ImagedDifference") -> dict[str, Any] | None:
    """Describe the smallest insulating bodies that can be detected in a frame; None if they are not known."""
    if (diameters := imaged.detectable_diameters) is None:
        return None
    is_noise_known = imaged.quality.difference_noise is not None or imaged.quality.noise_share is not None
    noise_text = "noise" if is_noise_known else "noise, which is assumed,"
    return describe_detectable(diameters, f"{noise_text} and model error")


def package_version(package: str) -> str | None:
    """Version of an installed package; None if the package is not installed."""
    try:
        return metadata.version(package)
    except metadata.PackageNotFoundError:
        return None


def to_plain_values(value: Any) -> Any:
    """Convert a value to types that JSON can represent: arrays to lists, complex numbers to dictionaries of their real
    and imaginary parts, and numbers that are not finite to None."""
    if isinstance(value, dict):
        return {key: to_plain_values(entry) for key, entry in value.items()}
    if isinstance(value, (list, tuple)):
        return [to_plain_values(entry) for entry in value]
    if hasattr(value, "tolist"):
        return to_plain_values(np.asarray(value).tolist())
    if isinstance(value, complex):
        return {"real": to_plain_values(value.real), "imaginary": to_plain_values(value.imag)}
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value
