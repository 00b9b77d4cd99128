"""What goes over the wire between a live session and its page: pictures as bytes, state as JSON, checked commands."""

from __future__ import annotations

import json
import math
import struct
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import AfterValidator, BaseModel, ConfigDict, Field, TypeAdapter, ValidationError

from jeit.live.pictures import LiveFrame, Picture, Scene

NO_PIXEL = -32768
"""Value of a pixel outside the body, in 16-bit integers."""

LONGEST_COMMAND = 4096
"""Bytes of the longest message that a page may send."""

_WIDEST_CURVE = 2000


class Command(BaseModel):
    """What a page asks for; anything beside the fields is refused."""

    model_config = ConfigDict(extra="forbid", strict=True, frozen=True)


class Drawn(Command):
    """The page has drawn a picture; `hidden`: it was out of sight meanwhile, so that the time says nothing."""

    do: Literal["drawn"]
    number: Annotated[int, Field(ge=0, lt=2**53)]
    hidden: bool = False


class Seen(Command):
    """The page has read the last state, and can be sent the next."""

    do: Literal["seen"]


class Follow(Command):
    """Send pictures as they come, or pause."""

    do: Literal["follow"]
    on: bool


class Show(Command):
    """Send a picture of the last minute, or its neighbour in a `direction` if that frame was not imaged."""

    do: Literal["show"]
    number: Annotated[int, Field(ge=0, lt=2**53)]
    direction: Literal[-1, 1] = -1


class Reference(Command):
    """Take the mean of the next `count` frames as the reference."""

    do: Literal["reference"]
    count: Annotated[int, Field(ge=1, le=10_000)]


def _one_line(text: str) -> str:
    line = " ".join("".join(letter if letter.isprintable() else " " for letter in text).split())
    if not line:
        raise ValueError("a label needs a letter")
    return line


class Mark(Command):
    """Note an event now."""

    do: Literal["mark"]
    label: Annotated[str, Field(min_length=1, max_length=200), AfterValidator(_one_line)]


class Record(Command):
    """Begin a recording, or end it."""

    do: Literal["record"]
    on: bool


_COMMANDS: TypeAdapter[Any] = TypeAdapter(
    Annotated[Drawn | Seen | Follow | Show | Reference | Mark | Record, Field(discriminator="do")]
)


def read_command(text: str | bytes) -> Command:
    """Return the command in a page's message; raises `ValueError` for anything else."""
    if len(text) > LONGEST_COMMAND:
        raise ValueError(f"a message of {len(text)} characters: at most {LONGEST_COMMAND}")
    try:
        return _COMMANDS.validate_json(text)
    except ValidationError as error:
        first = error.errors(include_url=False, include_input=False, include_context=False)[0]
        place = ".".join(str(part) for part in first["loc"])
        raise ValueError(f"{place or 'message'}: {first['msg']}") from None


def plain(value: Any) -> Any:
    """Return a value as JSON has it: NaN and infinity as null, NumPy's numbers and arrays as numbers and lists."""
    if isinstance(value, np.generic | np.ndarray):
        value = value.tolist()
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, Mapping):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple | set | frozenset):
        return [plain(item) for item in value]
    return value if value is None or isinstance(value, bool | int | str) else str(value)


def to_json(kind: str, content: Mapping[str, Any]) -> str:
    """Return a message of a kind as JSON text."""
    return json.dumps({"kind": kind, **plain(content)}, allow_nan=False, separators=(",", ":"))


def _curves(curves: Sequence[np.ndarray]) -> list[list[list[float]]]:
    """Curves with at most 2,000 points each, in tenths of micrometres' precision."""
    thinned = [np.asarray(curve, float)[:: 1 + len(curve) // _WIDEST_CURVE] for curve in curves]
    return [np.round(curve, 7).tolist() for curve in thinned]


def scene_message(scene: Scene) -> str:
    """Return what a page needs to know of a view once, as JSON text."""
    content = {
        "title": scene.title,
        "quantity": scene.quantity,
        "unit": scene.unit,
        "diverging": bool(scene.diverging),
        "extent": [float(edge) for edge in scene.extent],
        "outline": _curves(scene.outline),
        "electrodes": _curves(scene.electrodes),
        "names": list(scene.names),
        "channels": list(scene.channels),
        "notes": list(scene.notes),
    }
    return to_json("scene", content)


@dataclass(frozen=True)
class _Layout:
    """Channels and pixels as bytes, and what a reader of the bytes needs to know of them."""

    header: dict[str, Any]
    body: bytes


def _values(frame: LiveFrame) -> _Layout:
    if isinstance(frame.values, str):
        return _Layout({"channels": 0}, b"")
    values = np.asarray(frame.values, "<f4").ravel()
    return _Layout({"channels": values.size}, values.tobytes())


def _pixels(picture: Picture) -> _Layout:
    """Pixels in 16-bit integers: a 32,767th of the largest value, which is beyond what a colour shows."""
    if picture.pixels is None or picture.pixels.ndim != 2 or not picture.pixels.size:
        return _Layout({"shape": None, "scale": 0.0}, b"")
    pixels = np.asarray(picture.pixels, np.float32)
    valid = np.isfinite(pixels)
    largest = float(np.abs(pixels, where=valid, out=np.zeros_like(pixels)).max())
    scale = largest / 32767 if largest > 0 else 1.0
    whole = np.full(pixels.shape, NO_PIXEL, "<i2")
    whole[valid] = np.rint(pixels[valid] / scale)
    return _Layout({"shape": list(pixels.shape), "scale": scale}, whole.tobytes())


def picture_message(frame: LiveFrame, picture: Picture, *, latency: float, past: bool = False) -> bytes:
    """Return the bytes of one picture for the page; `past`: it was asked for, and is no news.

    Length of the header (4 bytes, little endian); header, JSON padded with spaces to a multiple of four; channels,
    float32; pixels from the largest y, int16, to be multiplied by the header's `scale`.
    """
    values, pixels = _values(frame), _pixels(picture)
    markers = [[mark.x, mark.y, mark.label, mark.radius, mark.track] for mark in picture.markers]
    header = {
        "number": int(frame.number),
        "second": float(frame.second),
        "status": str(picture.status.value),
        "reason": picture.reason,
        "latency": float(latency),
        "past": past,
        "markers": markers,
        **values.header,
        **pixels.header,
    }
    text = json.dumps(plain(header), allow_nan=False, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 4)
    return struct.pack("<I", len(text)) + text + values.body + pixels.body
