"""`Store`: a study's results on disk, a Zarr store in which a chunk either is finished or does not count.

Every point has files of its own, so that no chunk touches another's. Which chunks are finished stands, with a checksum
of each, in one file that is replaced as a whole, after the chunk's own.
"""

import hashlib
import json
import os
import shutil
import warnings
from collections.abc import Mapping
from importlib import metadata
from pathlib import Path
from types import ModuleType

import numpy as np

from jeit.design.study.batch import study_grid
from jeit.design.study.spec import Study

_PACKAGES = ("jeit", "jax", "numpy", "scipy")
_SCORES = {
    "minimum": {"minimum": ("V", "least sensitivity")},
    "mean": {"mean": ("V", "mean sensitivity")},
    "uniformity": {"uniformity": ("1", "mean sensitivity over its root mean square")},
    "blind_spot": {"blind_spot": ("1", "share of the area less sensitive than the noise of all channels")},
    "taxels": {
        "taxel_count": ("1", "virtual taxels of some area"),
        "taxel_area_mean": ("cm²", "mean area of the virtual taxels"),
        "taxel_area_std": ("cm²", "standard deviation of the virtual taxels' areas"),
        "taxel_area_max": ("cm²", "largest area of a virtual taxel"),
    },
    "information": {"information": ("nat", "log-determinant of the information on touches (D)")},
    "mean_variance": {"mean_variance": ("1", "mean posterior variance of a touch's amplitude (A)")},
    "largest_variance": {"largest_variance": ("1", "largest posterior variance of a pattern of touches (E)")},
    "localisation_error": {
        "localisation_error_mean": ("mm", "mean Cramér-Rao bound of a touch's place, infinite if one cannot be told"),
        "localisation_error_max": ("mm", "largest Cramér-Rao bound of a touch's place"),
        "localisation_lost": ("1", "share of the area where a touch's place cannot be told"),
    },
}


class Store:
    """The store of `study` at `path`; made empty if there is none."""

    def __init__(self, study: Study, path: str | Path, *, create: bool = True):
        """Raises `FileNotFoundError` if there is no store and none is to be made, `ValueError` if there is something
        else, or another study's, or if it is damaged, `ImportError` without the extra `cluster`, and `OSError` if it
        cannot be written."""
        zarr = require("zarr")
        self.study, self.path = study, Path(path)
        if not self.path.exists():
            if not create:
                raise FileNotFoundError(f"path: there is no study at {self.path}; run it first.")
            try:
                _create(zarr, study, self.path)
            except OSError as error:
                raise OSError(error.errno, f"the study's store cannot be made ({error.strerror})", str(path)) from error
        attributes = self._attributes()
        if not attributes:
            raise ValueError(
                f"{self.path} holds no study: name the store that 'jeit study run' wrote, or, for a new one, a place "
                "where nothing is."
            )
        if attributes.get("fingerprint") != study.fingerprint:
            raise ValueError(
                f"{self.path} holds the results of another study, or of this one before it was changed; move it away "
                "or choose another path."
            )
        try:
            self._group = zarr.open_group(str(self.path), mode="r+")
        except (OSError, ValueError, TypeError, KeyError) as error:
            raise self._damaged(error) from None

    @property
    def versions(self) -> dict[str, str]:
        """Of the packages that made the store."""
        return self._attributes()["versions"]

    def finished(self) -> dict[int, str]:
        """Checksum of every finished chunk, by its number."""
        return {int(number): checksum for number, checksum in self._attributes()["finished"].items()}

    def sound(self) -> list[int]:
        """Numbers of the finished chunks whose results read as they were written."""
        return [number for number, checksum in self.finished().items() if self._checksum(number) == checksum]

    def write(self, number: int, results: Mapping[str, np.ndarray]) -> None:
        """Write chunk `number`, then that it is finished. Raises `OSError`, after which it does not count."""
        try:
            for name, values in results.items():
                self.write_array(name, self.study.chunks[number], values)
            self._mark(number, _checksum(results))
        except OSError as error:
            raise OSError(
                error.errno,
                f"{error.strerror}: a chunk could not be written; {len(self.finished())} of {len(self.study.chunks)} "
                "chunks are finished and kept. Mend that, then resume the study",
                str(self.path),
            ) from error

    def write_array(self, name: str, points: tuple[int, ...], values: np.ndarray) -> None:
        """Write `values` (k, …) of array `name` at k points."""
        array = self._group[name]
        for point, value in zip(points, values, strict=True):
            array[point] = value  # pyright: ignore[reportIndexIssue]

    def _mark(self, number: int, checksum: str) -> None:
        content = _read_json(self.path)
        finished = content["attributes"]["finished"] | {str(number): checksum}
        content["attributes"]["finished"] = dict(sorted(finished.items(), key=lambda item: int(item[0])))
        # Beside the store, not in it: Zarr would wonder what it is if it were left behind.
        temporary = self.path.with_name(f".{self.path.name}.{os.getpid()}.tmp")
        try:
            with open(temporary, "w", encoding="utf-8") as file:
                json.dump(content, file, indent=1, ensure_ascii=False)
                file.flush()
                os.fsync(file.fileno())
            os.replace(temporary, self.path / "zarr.json")
        finally:
            temporary.unlink(missing_ok=True)

    def _checksum(self, number: int) -> str | None:
        points = list(self.study.chunks[number])
        try:
            return _checksum(
                {name: np.stack([self._group[name][point] for point in points]) for name in _arrays(self.study)}
            )  # pyright: ignore
        except (OSError, ValueError, RuntimeError):
            return None  # a file that cannot be decoded

    def _attributes(self) -> dict:
        """Those of a study's store; none if it is something else. Raises `ValueError` if they cannot be read."""
        try:
            content = _read_json(self.path)
        except (FileNotFoundError, NotADirectoryError):
            return {}
        except (OSError, ValueError) as error:
            raise self._damaged(error) from None
        attributes = content.get("attributes") if isinstance(content, dict) else None
        if not isinstance(attributes, dict) or "finished" not in attributes:
            return {}
        if not all(isinstance(attributes.get(name), dict) for name in ("finished", "versions")):
            raise self._damaged("what it says of finished chunks makes no sense")
        return attributes

    def _damaged(self, reason: object) -> ValueError:
        said = " ".join(str(reason).split()).rstrip(".")
        return ValueError(
            f"{self.path / 'zarr.json'} cannot be read ({said}): the store is damaged, and does not say what is "
            "finished. Put that file back from a copy; or move the store away and run the study again."
        )


def open_results(study: Study, path: str | Path):
    """The results as an `xarray.Dataset` with dimensions point and place; what is not finished is NaN.

    `xarray.open_zarr(path)` opens the same store, but cannot tell what an interrupted run left half-written. Raises as
    `Store` does.
    """
    xarray = require("xarray")
    store = Store(study, path, create=False)
    done = np.zeros(len(study.points), bool)
    for number in store.sound():
        done[list(study.chunks[number])] = True
    variables = {}
    with xarray.open_zarr(str(path)) as found:
        for name, variable in found.data_vars.items():
            values = np.full(variable.shape, np.nan)
            values[done] = variable[np.flatnonzero(done)]
            variables[name] = (variable.dims, values, variable.attrs)
        coordinates = {name: coordinate.load() for name, coordinate in found.coords.items()}
        return xarray.Dataset(variables, {**coordinates, "finished": ("point", done)}, found.attrs)


def require(name: str) -> ModuleType:
    """A package of the extra `cluster`. Raises `ImportError` that says so."""
    import importlib

    try:
        return importlib.import_module(name)
    except ImportError:
        raise ImportError(f"Studies need {name}: pip install 'jeit[cluster]'.") from None


def _arrays(study: Study) -> dict[str, tuple[str, str]]:
    """Unit and meaning of every result of `study`."""
    arrays = {"sensitivity": ("V", "sensitivity ‖Δv‖ to a touch")}
    for score, some in _SCORES.items():
        if score in study.scores:
            arrays |= some
    return arrays


def _create(zarr: ModuleType, study: Study, path: Path) -> None:
    """All at once: made under another name, then renamed."""
    temporary = path.with_name(f".{path.name}.{os.getpid()}.new")
    shutil.rmtree(temporary, ignore_errors=True)
    grid = study_grid(study)
    coordinates = [point.coordinates for point in study.points]
    along = {name: [values[name] for values in coordinates] for name in coordinates[0]}
    attributes = {
        "coordinates": " ".join([*along, "x_mm", "y_mm"]),
        "fingerprint": study.fingerprint,
        "finished": {},
        "name": study.name,
        "study": study.text,
        "versions": {name: metadata.version(name) for name in _PACKAGES},
    }
    try:
        group = zarr.open_group(str(temporary), mode="w", zarr_format=3, attributes=attributes)
        for name, values in along.items():
            _write_whole(group, name, "point", values)
        for axis, values in enumerate(np.asarray(grid.places).T):
            _write_whole(group, ("x_mm", "y_mm")[axis], "place", np.round(1e3 * values, 9).tolist())
        number, places = len(study.points), len(grid.places)
        for name, (unit, meaning) in _arrays(study).items():
            wide = name == "sensitivity"
            group.create_array(
                name,
                shape=(number, places) if wide else (number,),
                chunks=(1, places) if wide else (1,),
                dtype="float64",
                fill_value=np.nan,
                dimension_names=("point", "place") if wide else ("point",),
                attributes={"units": unit, "long_name": meaning},
            )
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", message="Consolidated metadata is currently not part")
            zarr.consolidate_metadata(str(temporary))
        os.rename(temporary, path)
    finally:
        shutil.rmtree(temporary, ignore_errors=True)


def _write_whole(group, name: str, dimension: str, values: list) -> None:
    text = isinstance(values[0], str)
    array = np.array(values, dtype=object if text else None)
    written = group.create_array(
        name, shape=array.shape, chunks=array.shape, dtype=str if text else array.dtype, dimension_names=(dimension,)
    )
    written[:] = array


def _checksum(results: Mapping[str, np.ndarray]) -> str:
    digest = hashlib.sha256()
    for name in sorted(results):
        digest.update(name.encode() + np.ascontiguousarray(results[name], dtype=float).tobytes())
    return digest.hexdigest()


def _read_json(path: Path) -> dict:
    return json.loads((path / "zarr.json").read_text("utf-8"))
