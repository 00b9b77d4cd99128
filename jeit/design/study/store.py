"""`Store`: results of a study or of other chunked work on disk, in Zarr; a chunk is either finished or does not count.

Chunks have separate files. The list of finished chunks, with a checksum of each, is in one file that is replaced as a
whole after the files of a chunk are written.
"""

from __future__ import annotations

import contextlib
import glob
import hashlib
import json
import os
import shutil
import warnings
from collections.abc import Iterator, Mapping, Sequence
from importlib import metadata
from pathlib import Path
from types import ModuleType

import numpy as np

from jeit.arguments import check_kind
from jeit.arguments.extras import optional
from jeit.design.study.contents import Contents, study_contents
from jeit.design.study.lock import locked
from jeit.design.study.spec import Study
from jeit.design.study.store_check import ArrayShape, damage, danger

_PACKAGES = ("jeit", "jax", "numpy", "scipy")
_TASK = "a store of results"
_A_PATH = "that of the store, such as 'results.zarr'"


class OtherContents(ValueError):
    """Raised where a store has other contents than requested."""


class Store:
    """The store of a study, or of other `Contents`, at `path`; made empty if there is none, or only read where none is
    to be made. See `writing`."""

    def __init__(self, work: Study | Contents, path: str | Path, *, create: bool = True):
        """Raises `FileNotFoundError` if there is no store and none is to be made, `ValueError` if there is something
        else, or another study's, or if it is damaged, or might run code when it is opened, `ImportError` without the
        extra `cluster`, and `OSError` if it cannot be written."""
        zarr = optional("zarr", _TASK)
        self.contents = work if isinstance(work, Contents) else study_contents(work)
        check_kind("path", path, (str, os.PathLike), _A_PATH)
        self.path, kind = Path(path), self.contents.kind
        if not self.path.exists():
            if not create:
                raise FileNotFoundError(f"path: there is no {kind} at {self.path}; run it first.")
            try:
                _create(zarr, self.contents, self.path)
            except OSError as error:
                raise OSError(
                    error.errno, f"the {kind}'s store cannot be made ({error.strerror})", str(path)
                ) from error
        attributes = self._attributes()
        if not attributes:
            raise ValueError(
                f"{self.path} holds no {kind}: name the store that {self.contents.made_by} wrote, or, for a new one, a "
                "place where nothing is."
            )
        if attributes.get("fingerprint") != self.contents.fingerprint:
            raise OtherContents(
                f"{self.path} holds the results of another {kind}, or of this one before it was changed; move it away "
                "or choose another path."
            )
        self._check(_shapes(zarr, self.contents))
        try:
            self._group = zarr.open_group(str(self.path), mode="r+" if create else "r", zarr_format=3)
        except (OSError, ValueError, TypeError, KeyError) as error:
            raise self._damaged(error) from None

    @property
    def versions(self) -> dict[str, str]:
        """Versions of the packages that made the store."""
        return self._attributes()["versions"]

    def finished(self) -> dict[int, str]:
        """Checksum of every finished chunk, by its number."""
        return {int(number): checksum for number, checksum in self._attributes()["finished"].items()}

    def sound(self) -> list[int]:
        """Numbers of the finished chunks whose results match their checksums."""
        return [number for number, checksum in self.finished().items() if self._checksum(number) == checksum]

    def write(self, number: int, results: Mapping[str, np.ndarray]) -> None:
        """Write chunk `number`, then mark it as finished. Raises `OSError`, after which it does not count."""
        try:
            for name, values in results.items():
                self.write_array(name, self.contents.chunks[number], values)
            self._mark(number, _checksum(results))
        except OSError as error:
            kept = f"{len(self.finished())} of {len(self.contents.chunks)} chunks are finished and kept"
            raise OSError(
                error.errno,
                f"{error.strerror}: a chunk could not be written; {kept}. Mend that, then resume the "
                f"{self.contents.kind}",
                str(self.path),
            ) from error

    def write_array(self, name: str, points: Sequence[int], values: np.ndarray) -> None:
        """Write `values` (k, …) of array `name` at k points."""
        array, first = self._group[name], 0
        for rows in _runs(points):
            last = first + rows.stop - rows.start
            array[rows] = values[first:last]  # pyright: ignore[reportIndexIssue]
            first = last

    def _mark(self, number: int, checksum: str) -> None:
        content = _read_json(self.path)
        finished = content["attributes"]["finished"] | {str(number): checksum}
        content["attributes"]["finished"] = dict(sorted(finished.items(), key=lambda item: int(item[0])))
        # Beside the store, not in it, where a file left behind would be unknown to Zarr.
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
        runs = _runs(self.contents.chunks[number])
        try:
            return _checksum(
                {name: np.concatenate([self._group[name][rows] for rows in runs]) for name in self.contents.arrays}
            )  # pyright: ignore
        except (OSError, ValueError, RuntimeError):
            return None  # a file that cannot be decoded

    def open_dataset(self):
        """The whole store as an `xarray.Dataset`, read when it is asked for."""
        return optional("xarray", _TASK).open_zarr(str(self.path), chunks=None, zarr_format=3)

    def _check(self, expected: Mapping[str, ArrayShape]) -> None:
        """Check the store before Zarr opens any of it."""
        try:
            reason = danger(self.path)
            wrong = None if reason else damage(self.path, expected)
        except OSError as error:
            raise self._damaged(error) from None
        if reason:
            raise ValueError(
                f"{self.path} is not opened, because it might run code or write elsewhere: {reason}. No "
                f"{self.contents.kind} that jeit wrote is like that. Delete it if it came from somebody else, and run "
                f"the {self.contents.kind} yourself, to another place."
            )
        if wrong:
            raise self._damaged(wrong)

    def _attributes(self) -> dict:
        """Attributes of a study's store; empty for anything else. Raises `ValueError` if they cannot be read."""
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
            f"finished. Put that file back from a copy; or move the store away and run the {self.contents.kind} again."
        )


@contextlib.contextmanager
def writing(work: Study | Contents, path: str | Path) -> Iterator[Store]:
    """Open the store of `work` at `path`, created empty if there is none, for this process alone to write.

    Temporary files of killed runs are removed. Raises as `Store` does, and `ValueError` where another process writes
    it.
    """
    check_kind("path", path, (str, os.PathLike), _A_PATH)
    contents = work if isinstance(work, Contents) else study_contents(work)
    path = Path(path)
    with locked(path, contents.kind):
        _clear_beside(path)
        store = Store(contents, path)
        for left in path.rglob("*.partial"):  # of Zarr
            left.unlink(missing_ok=True)
        yield store


def open_results(study: Study, path: str | Path):
    """Open the results as an `xarray.Dataset` with dimensions point and place; unfinished points are NaN.

    `xarray.open_zarr(path)` opens the same store, but does not detect half-written chunks of an interrupted run, nor
    code that somebody else's store may run. Raises as `Store` does.
    """
    xarray = optional("xarray", _TASK)
    store = Store(study, path, create=False)
    done = np.zeros(len(study.points), bool)
    for number in store.sound():
        done[list(study.chunks[number])] = True
    variables = {}
    with store.open_dataset() as found:
        for name, variable in found.data_vars.items():
            values = np.full(variable.shape, np.nan)
            values[done] = variable[np.flatnonzero(done)]
            variables[name] = (variable.dims, values, variable.attrs)
        coordinates = {name: coordinate.load() for name, coordinate in found.coords.items()}
        return xarray.Dataset(variables, {**coordinates, "finished": ("point", done)}, found.attrs)


def _shapes(zarr: ModuleType, contents: Contents) -> dict[str, ArrayShape]:
    """Of the arrays that `contents` fills a store with: of one in memory, which has no values."""
    group = zarr.open_group(zarr.storage.MemoryStore(), mode="w", zarr_format=3)
    contents.fill(group)
    return {
        name: ArrayShape(array.shape, array.chunks, array.metadata.to_dict()["data_type"])
        for name, array in group.arrays()
    }


def _runs(points: Sequence[int]) -> list[slice]:
    """Group consecutive points."""
    places = np.asarray(points)
    ends = np.flatnonzero(np.diff(places) != 1) + 1
    return [slice(int(run[0]), int(run[-1]) + 1) for run in np.split(places, ends)]


def _create(zarr: ModuleType, contents: Contents, path: Path) -> None:
    """Create the store atomically: under another name, then renamed."""
    temporary = path.with_name(f".{path.name}.{os.getpid()}.new")
    shutil.rmtree(temporary, ignore_errors=True)
    attributes = {
        **contents.attributes,
        "fingerprint": contents.fingerprint,
        "finished": {},
        "versions": {name: metadata.version(name) for name in _PACKAGES},
    }
    try:
        group = zarr.open_group(str(temporary), mode="w", zarr_format=3, attributes=dict(sorted(attributes.items())))
        contents.fill(group)
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", message="Consolidated metadata is currently not part")
            zarr.consolidate_metadata(str(temporary))
        os.rename(temporary, path)
    finally:
        shutil.rmtree(temporary, ignore_errors=True)


def _clear_beside(path: Path) -> None:
    """Remove the files that killed runs have left beside the store."""
    for left in path.parent.glob(f".{glob.escape(path.name)}.*"):
        pid, _, kind = left.name.removeprefix(f".{path.name}.").partition(".")
        if pid.isdecimal() and kind == "new":
            shutil.rmtree(left, ignore_errors=True)
        elif pid.isdecimal() and kind == "tmp":
            left.unlink(missing_ok=True)


def _checksum(results: Mapping[str, np.ndarray]) -> str:
    digest = hashlib.sha256()
    for name in sorted(results):
        digest.update(name.encode() + np.ascontiguousarray(results[name], dtype=float).tobytes())
    return digest.hexdigest()


def _read_json(path: Path) -> dict:
    try:
        return json.loads((path / "zarr.json").read_bytes())
    except RecursionError:
        raise ValueError("it is nested too deep") from None
