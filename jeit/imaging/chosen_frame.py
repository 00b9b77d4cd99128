"""Which of a file's frames is imaged, and errors that say which."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from jeit.data import Measurement


def chosen_frame(measurement: Measurement, frame: int | str | None = None) -> int:
    """The number, from 0, of the frame to image: the one asked for, by number or name, or the first that is not the
    file's own reference. Raises `ValueError` for a frame that there is not."""
    if frame is not None:
        return measurement.frame_number(frame)
    return int(measurement.num_frames > 1 and measurement.frame_names[:1] == ("reference",))


@contextmanager
def naming_frame(measurement: Measurement, number: int) -> Iterator[None]:
    """A `ValueError` that names the measurement and is raised within names the frame too, where there are several."""
    try:
        yield
    except ValueError as error:
        name = f"'{measurement.name}'"
        if measurement.num_frames < 2 or name not in str(error):
            raise
        raise ValueError(str(error).replace(name, f"{name}, frame {number}", 1)) from error
