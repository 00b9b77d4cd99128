"""Frames from files that an instrument writes into a folder."""

from __future__ import annotations

import os
import time
from collections.abc import Iterator
from pathlib import Path

from jeit.arguments import counted
from jeit.data import Measurement, read
from jeit.imaging.stream_preparation import frames_of
from jeit.live.pictures import LiveFrame
from jeit.live.sources import CONNECTED, ENDED, AbstractSource

# Minimum pause in seconds between two listings of the folder; minimum ratio of the pause to the duration of a listing,
# for folders of many files; and time in seconds after which an unreadable file is refused (earlier, the instrument may
# still be writing it).
_MIN_PAUSE, _PAUSE_FACTOR, _READ_TIMEOUT = 0.02, 4.0, 2.0


class WatchedFolder(AbstractSource):
    """Source of the frames in files that appear in a folder, in the order of file names. Files that already exist are
    left out, unless a `rate` in frames/s is given.

    A file is read when its size is the same in two successive listings of the folder. `description`, `reference`: as
    `description` and `like` of `jeit.data.read`. A file that cannot be read becomes a frame that holds the
    error message in place of values; views refuse such frames.
    """

    def __init__(
        self,
        folder: Path,
        description: str | Path | None = None,
        reference: Measurement | None = None,
        rate: float | None = None,
    ):
        super().__init__(str(folder))
        self.folder, self.description, self.reference, self.rate = folder, description, reference, rate
        self._known_names = set() if rate is not None else set(self._list_sizes())
        self._pending_files: dict[str, tuple[int, float]] = {}
        if self._known_names:
            self.say(
                f"Left out: {counted(len(self._known_names), 'file')} that were in the folder before; --rate plays "
                "them, too."
            )

    def __iter__(self) -> Iterator[LiveFrame]:
        self.begun = time.monotonic()
        pause = _MIN_PAUSE
        while not self.closing.wait(pause):
            start = time.monotonic()
            try:
                sizes = self._list_sizes()
            except OSError as error:
                if self.connection == CONNECTED:
                    self.connection = f"waiting: {error}"[:300]
                    self.say(f"The folder cannot be read: {error}.")
                continue
            pause = max(_MIN_PAUSE, _PAUSE_FACTOR * (time.monotonic() - start))
            if self.connection != CONNECTED:
                self.connection = CONNECTED
                self.say("The folder can be read again.")
            self._known_names &= sizes.keys()
            for name in [name for name in self._pending_files if name not in sizes]:
                del self._pending_files[name]
            for name in sorted(sizes.keys() - self._known_names):
                yield from self._read_file(name, sizes[name])
        self.connection = ENDED

    def _list_sizes(self) -> dict[str, int]:
        """Sizes of the files in the folder by name. Hidden and temporary files are left out, because programs write
        such files first and then rename them."""
        with os.scandir(self.folder) as entries:
            sizes = {}
            for entry in entries:
                try:
                    if (
                        not entry.name.startswith(".")
                        and not entry.name.endswith((".toml", ".part", ".tmp"))
                        and entry.is_file()
                    ):
                        sizes[entry.name] = entry.stat().st_size
                except OSError:  # the file was removed after the listing
                    continue
            return sizes

    def _read_file(self, name: str, size: int) -> Iterator[LiveFrame]:
        """Yield the frames of a file if the file is complete."""
        previous_size, size_time = self._pending_files.get(name, (-1, time.monotonic()))
        if size != previous_size:
            size_time = time.monotonic()
        self._pending_files[name] = size, size_time
        if size != previous_size or not size:
            return
        try:
            measured = read(self.folder / name, description=self.description, like=self.reference)
            frames = frames_of(measured)
            if frames.dtype.kind == "c":
                raise ValueError(f"{name}: the voltages are complex; choose a part with [data] component.")
        except (ValueError, OSError) as error:
            if time.monotonic() - size_time < _READ_TIMEOUT:
                return
            self._mark_as_read(name)
            yield self.frame(f"{error}"[:400])
            return
        self._mark_as_read(name)
        for values in frames:
            if self.rate is not None:
                due_time = self.begun + self._num_frames / self.rate
                if self.closing.wait(max(0.0, due_time - time.monotonic())):
                    return
            yield self.frame(values)

    def _mark_as_read(self, name: str) -> None:
        self._pending_files.pop(name, None)
        self._known_names.add(name)
