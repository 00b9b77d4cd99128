"""Messages between a live session and its page: pictures as bytes, states as JSON, and validated commands."""

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

OUTSIDE_PIXEL_VALUE = -32768
"""Value of a pixel outside the body, in 16-bit integers."""

MAX_COMMAND_LENGTH = 4096
"""Maximum length in bytes of a message that a page may send."""

_MAX_CURVE_POINTS = 2000


class Command(BaseModel):
    """Base class of the commands that a page sends. Keys that are not fields are refused."""

    model_config = ConfigDict(extra="forbid", strict=True, frozen=True)


class Drawn(Command):
    """Report that the page has drawn the picture of the frame `number`. `hidden`: whether the page was hidden while the
    picture was sent, so that the latency is not meaningful."""

    do: Literal["drawn"]
    number: Annotated[int, Field(ge=0, lt=2**53)]
    hidden: bool = False


class Seen(Command):
    """Report that the page has read the last state of the session, so that the next state can be sent."""

    do: Literal["seen"]


class Follow(Command):
    """Command to send new pictures to the page (`on`), or to pause."""

    do: Literal["follow"]
    on: bool


class Show(Command):
    """Command to send the picture of a past frame `number`, or of the nearest imaged frame in the `direction` (-1:
    earlier, 1: later)."""

    do: Literal["show"]
    number: Annotated[int, Field(ge=0, lt=2**53)]
    direction: Literal[-1, 1] = -1


class Reference(Command):
    """Command to take the mean of the next `count` frames as the reference."""

    do: Literal["reference"]
    count: Annotated[int, Field(ge=1, le=10_000)]


def _join_to_one_line(text: str) -> str:
    line = " ".join("".join(character if character.isprintable() else " " for character in text).split())
    if not line:
        raise ValueError("a label needs a letter")
    return line


class Mark(Command):
    """Command to mark an event with the text `label` at the present time."""

    do: Literal["mark"]
    label: Annotated[str, Field(min_length=1, max_length=200), AfterValidator(_join_to_one_line)]


class Record(Command):
    """Command to begin a recording (`on`), or to end the recording in progress."""

    do: Literal["record"]
    on: bool


_COMMAND_ADAPTER: TypeAdapter[Any] = TypeAdapter(
    Annotated[
        Drawn | Seen | Follow | Show | Reference | Mark | Record,
        Field(discriminator="do"),
    ]
)


def read_command(text: str | bytes) -> Command:
    """Return the command in a message from a page; raises `ValueError` for a message that is not a valid command."""
    if len(text) > MAX_COMMAND_LENGTH:
        raise ValueError(f"a message of {len(text)} characters: at most {MAX_COMMAND_LENGTH}")
    try:
        return _COMMAND_ADAPTER.validate_json(text)
    except ValidationError as error:
        first_error = error.errors(include_url=False, include_input=False, include_context=False)[0]
        fault_location = ".".join(str(location_part) for location_part in first_error["loc"])
        raise ValueError(f"{fault_location or 'message'}: {first_error['msg']}") from None


def to_json_types(value: Any) -> Any:
    """Convert a value to types of JSON: NaN and infinity to null, numbers and arrays of NumPy to numbers and lists."""
    if isinstance(value, np.generic | np.ndarray):
        value = value.tolist()
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, Mapping):
        return {str(table_key): to_json_types(table_value) for table_key, table_value in value.items()}
    if isinstance(value, list | tuple | set | frozenset):
        return [to_json_types(table_value) for table_value in value]
    return value if value is None or isinstance(value, bool | int | str) else str(value)


def to_json(kind: str, fields: Mapping[str, Any]) -> str:
    """Return a message of the given `kind`, such as "state", as JSON text."""
    return json.dumps({"kind": kind, **to_json_types(fields)}, allow_nan=False, separators=(",", ":"))


def _curve_lists(point_curves: Sequence[np.ndarray]) -> list[list[list[float]]]:
    """Convert curves to lists of at most 2,000 points each, with coordinates rounded to tenths of a micrometre."""
    thinned_curves = [
        np.asarray(curve_points, float)[:: 1 + len(curve_points) // _MAX_CURVE_POINTS] for curve_points in point_curves
    ]
    return [np.round(curve_points, 7).tolist() for curve_points in thinned_curves]


def scene_message(scene: Scene) -> str:
    """Return the scene of a view (outline, electrodes, names), which is sent to a page once, as JSON text."""
    message_fields = {
        "title": scene.title,
        "quantity": scene.quantity,
        "unit": scene.unit,
        "diverging": bool(scene.diverging),
        "extent": [float(extent_edge) for extent_edge in scene.extent],
        "outline": _curve_lists(scene.outline),
        "electrodes": _curve_lists(scene.electrodes),
        "names": list(scene.names),
        "channels": list(scene.channels),
        "notes": list(scene.notes),
    }
    return to_json("scene", message_fields)


@dataclass(frozen=True)
class _EncodedArray:
    """An array as bytes, with the part of the message header that describes the array."""

    header_fields: dict[str, Any]
    body_bytes: bytes


def _encode_values(frame: LiveFrame) -> _EncodedArray:
    if isinstance(frame.values, str):
        return _EncodedArray({"channels": 0}, b"")
    value_array = np.asarray(frame.values, "<f4").ravel()
    return _EncodedArray({"channels": value_array.size}, value_array.tobytes())


def _encode_pixels(picture: Picture) -> _EncodedArray:
    """Encode the pixels of a picture as 16-bit integers, in units of the largest magnitude divided by 32,767. This
    resolution is finer than that of the page's colours."""
    if picture.pixels is None or picture.pixels.ndim != 2 or not picture.pixels.size:
        return _EncodedArray({"shape": None, "scale": 0.0}, b"")
    pixel_array = np.asarray(picture.pixels, np.float32)
    is_valid = np.isfinite(pixel_array)
    largest_magnitude = float(np.abs(pixel_array, where=is_valid, out=np.zeros_like(pixel_array)).max())
    pixel_unit = largest_magnitude / 32767 if largest_magnitude > 0 else 1.0
    pixel_integers = np.full(pixel_array.shape, OUTSIDE_PIXEL_VALUE, "<i2")
    pixel_integers[is_valid] = np.rint(pixel_array[is_valid] / pixel_unit)
    return _EncodedArray({"shape": list(pixel_array.shape), "scale": pixel_unit}, pixel_integers.tobytes())


def picture_message(frame: LiveFrame, picture: Picture, *, latency: float, is_past: bool = False) -> bytes:
    """Return the message with one picture for the page as bytes. `is_past`: whether the page requested a past picture.

    The message consists of the length of the header (4 bytes, little endian); the header, JSON padded with spaces to a
    multiple of four bytes; the channels, float32; and the pixels, row of the largest y first, int16, to be multiplied
    by `scale` of the header.
    """
    encoded_values, encoded_pixels = _encode_values(frame), _encode_pixels(picture)
    marker_fields = [[marker.x, marker.y, marker.label, marker.radius, marker.track] for marker in picture.markers]
    header_fields = {
        "number": int(frame.number),
        "second": float(frame.second),
        "status": str(picture.status.value),
        "reason": picture.reason,
        "latency": float(latency),
        "past": is_past,
        "markers": marker_fields,
        **encoded_values.header_fields,
        **encoded_pixels.header_fields,
    }
    text = json.dumps(to_json_types(header_fields), allow_nan=False, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 4)
    return struct.pack("<I", len(text)) + text + encoded_values.body_bytes + encoded_pixels.body_bytes
