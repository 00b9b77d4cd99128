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

# Seconds from one look into the folder to the next; as a multiple of what a look takes, in folders of many files; and
# after which a file that cannot be read is refused: the instrument may still be writing.
_LOOK, _MULTIPLE, _PATIENCE = 0.02, 4.0, 2.0


class WatchedFolder(AbstractSource):
    """The frames in files that appear in a folder, in the order of their names; files that were there before are left
    out, unless a `rate`, frames/s, is given.

    A file is read once it has kept its size from one look to the next. `description`, `reference`: as `description`
    and `like` of `jeit.data.read`. A file that cannot be read is delivered as text, to be refused.
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
        self._seen = set() if rate is not None else set(self._sizes())
        self._pending: dict[str, tuple[int, float]] = {}
        if self._seen:
            self.say(
                f"Left out: {counted(len(self._seen), 'file')} that were in the folder before; --rate plays them, too."
            )

    def __iter__(self) -> Iterator[LiveFrame]:
        self.begun = time.monotonic()
        pause = _LOOK
        while not self.closing.wait(pause):
            start = time.monotonic()
            try:
                sizes = self._sizes()
            except OSError as error:
                if self.connection == CONNECTED:
                    self.connection = f"waiting: {error}"[:300]
                    self.say(f"The folder cannot be read: {error}.")
                continue
            pause = max(_LOOK, _MULTIPLE * (time.monotonic() - start))
            if self.connection != CONNECTED:
                self.connection = CONNECTED
                self.say("The folder can be read again.")
            self._seen &= sizes.keys()
            for name in [one for one in self._pending if one not in sizes]:
                del self._pending[name]
            for name in sorted(sizes.keys() - self._seen):
                yield from self._file(name, sizes[name])
        self.connection = ENDED

    def _sizes(self) -> dict[str, int]:
        """Sizes of the files in the folder; hidden ones, which programs write before they rename them, are left out."""
        with os.scandir(self.folder) as entries:
            sizes = {}
            for one in entries:
                try:
                    if (
                        not one.name.startswith(".")
                        and not one.name.endswith((".toml", ".part", ".tmp"))
                        and one.is_file()
                    ):
                        sizes[one.name] = one.stat().st_size
                except OSError:  # removed meanwhile
                    continue
            return sizes

    def _file(self, name: str, size: int) -> Iterator[LiveFrame]:
        """Frames of a file, if it is complete."""
        before, since = self._pending.get(name, (-1, time.monotonic()))
        if size != before:
            since = time.monotonic()
        self._pending[name] = size, since
        if size != before or not size:
            return
        try:
            measured = read(self.folder / name, description=self.description, like=self.reference)
            frames = frames_of(measured)
            if frames.dtype.kind == "c":
                raise ValueError(f"{name}: the voltages are complex; choose a part with [data] component.")
        except (ValueError, OSError) as error:
            if time.monotonic() - since < _PATIENCE:
                return
            self._done(name)
            yield self.frame(f"{error}"[:400])
            return
        self._done(name)
        for values in frames:
            if self.rate is not None:
                due = self.begun + self._number / self.rate
                if self.closing.wait(max(0.0, due - time.monotonic())):
                    return
            yield self.frame(values)

    def _done(self, name: str) -> None:
        self._pending.pop(name, None)
        self._seen.add(name)
