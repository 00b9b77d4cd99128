"""Readers of recordings by clinical systems: Dräger, Carefusion, Göttingen and Swisstom.

The systems of Dräger, Carefusion and Göttingen measure the same channels, see `jeit.data.formats.recording`. The scale
of the voltages is not published by any maker; a note of each measurement says so.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import ClassVar

import numpy as np

from jeit.data.formats.recording import (
    CHANNELS,
    Recording,
    adjacent_recording,
    count_frames,
    create_measurement,
    find_or_load_description,
    read_file_bytes,
    truncation_notes,
)
from jeit.data.measurement import Measurement
from jeit.protocol import skip

# Mark in the first bytes of files by Dräger's software.
_DRAEGER_MARK = b"---Draeger EIT-Software"
_SCALE_NOTE = "neither unit nor gain of the voltages is known: trust relative changes, not volts."
_POLARITY_NOTE = "electrode pairs are assumed to have the polarity that makes voltages positive."


class Draeger:
    """Reader of recordings by Dräger's PulmoVista 500 (.eit): a text header, followed by frames of equal size.

    Numbers are little-endian. Bytes 0-3 are the version of the format and bytes 4-7 the length of the header text;
    frames begin at byte 16 + this length. The text states the frame rate as "Framerate [Hz]:". A frame has 5,495 bytes
    in version 50 and later, and 5,200 bytes in version 32. A frame begins with 600 numbers of eight bytes. The first
    208 numbers, and the 208 numbers from number 322 on, are two parts whose weighted sum is the voltages of the
    adjacent protocol. The maker has not published the weights; the weights used here are estimates by users.
    """

    DESCRIPTION = "Dräger PulmoVista (.eit): 208 adjacent voltages a frame, with their rate"
    # Bytes per frame for each version of the format. Frames of version 31 are too short for the known layout.
    _FRAME_BYTES: ClassVar = {0x20: 5200, 0x33: 5495}
    _PREFIX_BYTES = 16
    # Index of the first number of the second part of the voltages, and the weights of the two parts.
    _SECOND_PART, _WEIGHTS = 322, (9.8242e-4, 1.9607e-4)
    _SCALE_NOTES = (
        "the scale of the voltages is an estimate, not published: trust relative changes, not volts.",
        _POLARITY_NOTE,
    )

    @classmethod
    def recognises(cls, path: Path) -> bool:
        """Whether a file is an .eit file whose first bytes name Dräger's software."""
        if path.suffix.lower() != ".eit":
            return False
        with path.open("rb") as file:
            return _DRAEGER_MARK in file.read(80)

    @classmethod
    def read(cls, path: Path, description: str | Path | None = None) -> Measurement:
        """Read all frames of a Dräger recording. Raises `ValueError` for an unknown version, a file without a complete
        frame, and a header without a frame rate."""
        data = read_file_bytes(path)
        version, length = (int(number) for number in np.frombuffer(data[:8].ljust(8, b"\0"), "<i4"))
        if version not in cls._FRAME_BYTES:
            known_versions = ", ".join(str(known_version) for known_version in cls._FRAME_BYTES)
            raise ValueError(
                f"{path.name} is of Dräger's format {version}; only {known_versions} are known. Export it as a table."
            )
        frames_start, frame_size = length + cls._PREFIX_BYTES, cls._FRAME_BYTES[version]
        num_frames, num_leftover_bytes = count_frames(data, frames_start, frame_size, path)
        rate = cls._rate(data[:frames_start], path)
        frames = np.frombuffer(data, np.uint8, num_frames * frame_size, frames_start).reshape(num_frames, frame_size)
        values = frames[:, : 8 * (cls._SECOND_PART + CHANNELS)].copy().view("<f8")
        first_part, second_part = values[:, :CHANNELS], values[:, cls._SECOND_PART :]
        with np.errstate(invalid="ignore", over="ignore"):
            voltages = cls._WEIGHTS[0] * first_part - cls._WEIGHTS[1] * second_part
        recording = adjacent_recording(
            voltages, np.arange(num_frames) / rate, (*cls._SCALE_NOTES, *truncation_notes(num_leftover_bytes))
        )
        return create_measurement(path, recording, find_or_load_description(path, description))

    @staticmethod
    def _rate(header: bytes, path: Path) -> float:
        """Frame rate in frames per second, from the header."""
        match = re.search(rb"Framerate \[Hz\]:[ \t]{0,40}([0-9]{1,6}(?:[.,][0-9]{1,6})?)", header)
        rate = 0.0 if match is None else float(match[1].replace(b",", b"."))
        if not rate > 0:
            raise ValueError(f"{path.name}: its header says no 'Framerate [Hz]:'; is it damaged?")
        return rate


class Carefusion:
    """Reader of recordings by Carefusion's Goe-MF II (.eit): XML in UTF-16, followed by binary segments.

    `<Header>N bytes</Header>` states the offset of the first segment. A segment begins with six little-endian integers
    of four bytes: the type of the segment, a channel, the frame number counted from 0, the bytes per item, the number
    of items, and an integer of unknown meaning; the items follow. Type 3 is a frame of 256 numbers of four bytes; the
    208 numbers from the 48th on are the voltages of the adjacent protocol. Type 7 is an image of 912 numbers. Other
    types are waveforms.
    """

    DESCRIPTION = "Carefusion Goe-MF II (.eit): 208 adjacent voltages a frame"
    _BYTE_ORDER_MARK, _ROOT_TAG, _HEAD_BYTES = b"\xff\xfe", "<EIT_File>", 512
    # Number of integers before the items of a segment; the two segment types of fixed length, and their lengths in
    # numbers of four bytes.
    _NUM_HEADER_INTEGERS, _VOLTAGE_SEGMENT, _IMAGE_SEGMENT = 6, 3, 7
    _SEGMENT_LENGTHS: ClassVar = {_VOLTAGE_SEGMENT: 256, _IMAGE_SEGMENT: 912}
    _FIRST_VOLTAGE = 47
    _NO_RATE_NOTE = "the file says no rate that is known; give it by [data] frame_rate."

    @classmethod
    def recognises(cls, path: Path) -> bool:
        """Whether a file is an .eit file that begins with the XML header of Carefusion's format."""
        if path.suffix.lower() != ".eit":
            return False
        with path.open("rb") as file:
            return cls._ROOT_TAG in cls._decode_head(file.read(cls._HEAD_BYTES))

    @classmethod
    def read(cls, path: Path, description: str | Path | None = None) -> Measurement:
        """Read all frames of a Carefusion recording. Raises `ValueError` if the header does not state its length, and
        if there is no complete frame."""
        data = read_file_bytes(path)
        match = re.search(r"<Header>\s{0,9}([0-9]{1,9}) bytes</Header>", cls._decode_head(data[: cls._HEAD_BYTES]))
        if match is None or not cls._HEAD_BYTES // 8 < int(match[1]) < len(data):
            raise ValueError(f"{path.name}: its header does not say where the frames begin; is it damaged?")
        frames, num_leftover_bytes = cls._frames(data, int(match[1]))
        if not frames:
            raise ValueError(f"{path.name} holds no whole frame; is it cut off?")
        sensor_description = find_or_load_description(path, description)
        rate_notes = (cls._NO_RATE_NOTE,) if sensor_description.layout.frame_rate is None else ()
        recording = adjacent_recording(
            np.stack(frames), None, (_SCALE_NOTE, *rate_notes, *truncation_notes(num_leftover_bytes))
        )
        return create_measurement(path, recording, sensor_description)

    @classmethod
    def _decode_head(cls, data: bytes) -> str:
        return (
            data[len(cls._BYTE_ORDER_MARK) :].decode("utf-16-le", "ignore")
            if data.startswith(cls._BYTE_ORDER_MARK)
            else ""
        )

    @classmethod
    def _frames(cls, data: bytes, start: int) -> tuple[list[np.ndarray], int]:
        """Voltages of every complete frame after byte `start`, and number of remaining bytes of a truncated last
        segment."""
        frames, offset = [], start
        while offset + 4 * cls._NUM_HEADER_INTEGERS <= len(data):
            kind, _, _, item_size, num_items, _ = (
                int(value) for value in np.frombuffer(data, "<i4", cls._NUM_HEADER_INTEGERS, offset)
            )
            length = (
                4 * cls._SEGMENT_LENGTHS[kind]
                if kind in cls._SEGMENT_LENGTHS
                else max(item_size, 0) * max(num_items, 0)
            )
            content_start = offset + 4 * cls._NUM_HEADER_INTEGERS
            if content_start + length > len(data):
                return frames, len(data) - offset
            if kind == cls._VOLTAGE_SEGMENT:
                frames.append(np.frombuffer(data, "<f4", CHANNELS, content_start + 4 * cls._FIRST_VOLTAGE))
            offset = content_start + length
        return frames, len(data) - offset


class Goettingen:
    """Reader of Göttingen's MCEIT recordings (.get), written by Goe-MF II, Viasys, Carefusion, and Dräger's systems
    before 2007.

    A file consists of frames of 256 little-endian numbers of four bytes, without a header: 208 voltages of the adjacent
    protocol, then 16 currents, 16 voltages of the drives and 16 auxiliary inputs. Dräger's systems write a text before
    the frames, which ends with two empty lines. Some systems do not measure channels that are redundant by reciprocity,
    and write zeros for them. A text file of the same name with the suffix .prl states the frame rate, as "Framerate =
    13 per second".
    """

    DESCRIPTION = "Göttingen MCEIT (.get): 208 adjacent voltages a frame"
    # Bytes per frame; the end of Dräger's text, and its maximum length in bytes.
    _FRAME_BYTES, _HEADER_END, _MAX_TEXT_BYTES = 1024, b"\r\n\r\n\r\n", 65536
    # Bytes that occur in text; minimum fraction of finite numbers in a frame, and maximum magnitude of these numbers.
    _TEXT_BYTES, _MIN_FINITE_SHARE, _MAX_VALUE = frozenset(b"\t\r\n" + bytes(range(32, 127))), 0.9, 1e9
    _NO_RATE_NOTE = "the file says no rate, nor a record beside it (.prl); give it by [data] frame_rate."
    _RATE = re.compile(rb"Framerate\s*=\s*(\d+(?:\.\d+)?)\s*per second", re.IGNORECASE)

    @classmethod
    def recognises(cls, path: Path) -> bool:
        """Whether a file is a .get file that begins with Dräger's text, or whose first frame may be voltages: neither
        text nor numbers too large for any instrument."""
        if path.suffix.lower() != ".get":
            return False
        with path.open("rb") as file:
            first_bytes = file.read(cls._FRAME_BYTES)
        if first_bytes.startswith(_DRAEGER_MARK) or len(first_bytes) < cls._FRAME_BYTES:
            return True
        if all(byte in cls._TEXT_BYTES for byte in first_bytes):
            return False
        first_frame = np.frombuffer(first_bytes, "<f4")
        finite_values = first_frame[np.isfinite(first_frame)]
        return len(finite_values) > cls._MIN_FINITE_SHARE * len(first_frame) and bool(
            (np.abs(finite_values) < cls._MAX_VALUE).all()
        )

    @classmethod
    def read(cls, path: Path, description: str | Path | None = None) -> Measurement:
        """Read all frames of a .get recording. Raises `ValueError` for a file without a complete frame or without any
        voltage."""
        data, frames_start = read_file_bytes(path), 0
        if data.startswith(_DRAEGER_MARK):
            header_end = data.find(cls._HEADER_END, 0, cls._MAX_TEXT_BYTES)
            if header_end < 0:
                raise ValueError(
                    f"{path.name}: its text does not end with two empty lines before the frames; is it whole?"
                )
            frames_start = header_end + len(cls._HEADER_END)
        num_frames, num_leftover_bytes = count_frames(data, frames_start, cls._FRAME_BYTES, path)
        values = np.frombuffer(data, "<f4", num_frames * cls._FRAME_BYTES // 4, frames_start).reshape(num_frames, -1)[
            :, :CHANNELS
        ]
        sensor_description, rate = find_or_load_description(path, description), cls._recorded_rate(path)
        rate_notes = (cls._NO_RATE_NOTE,) if rate is None and sensor_description.layout.frame_rate is None else ()
        times = None if rate is None else np.arange(num_frames) / rate
        return create_measurement(
            path,
            adjacent_recording(values, times, (_SCALE_NOTE, *rate_notes, *truncation_notes(num_leftover_bytes))),
            sensor_description,
        )

    @classmethod
    def _recorded_rate(cls, path: Path) -> float | None:
        """Frame rate in frames per second from the .prl file beside a recording; None if there is no such file, or no
        rate in it."""
        for suffix in (".prl", ".PRL"):
            record_path = path.with_suffix(suffix)
            if record_path.is_file():
                with record_path.open("rb") as file:
                    match = cls._RATE.search(file.read(cls._MAX_TEXT_BYTES))
                if match and float(match[1]) > 0:
                    return float(match[1])
        return None


class Swisstom:
    """Reader of Swisstom BB2 and Pioneer recordings (.eit, format 4) with 32 electrodes, and pairs that skip four
    electrodes.

    All numbers are little-endian. Bytes 0-3 are the number of the format, bytes 4-7 the offset of the first frame. A
    frame begins with its time in milliseconds (eight bytes), its kind and its length (four bytes each). Frames of kind
    0 are measurements: they continue with 15 integers of four bytes, of which the fifth is a time in microseconds, 12
    further bytes, 64 integers with impedances of the electrodes, and 2,048 integers with real and imaginary parts of 32
    × 32 voltages, drive by drive. Frames of other kinds are events. Formats 1 to 3 are not supported, because too
    little is known about them.
    """

    DESCRIPTION = "Swisstom BB2, Pioneer (.eit, format 4): 32 electrodes, skip 4, complex"
    _ELECTRODES, _SKIPPED, _FORMAT = 32, 4, 4
    # Number of bytes before the content of a frame, and in the content before the voltages; number of integers of the
    # voltages; offset of the time in the content.
    _HEADER_BYTES, _VOLTAGE_OFFSET, _NUM_INTEGERS, _TIME_OFFSET = 16, 60 + 12 + 256, 2 * _ELECTRODES**2, 16
    # Range of the four-byte counter of microseconds, after which it restarts at 0.
    _COUNTER_PERIOD = 2**32
    # Volts per unit of the stored numbers: an estimate by users of these files.
    _SCALE = 2.048 / (2**20 * 360 * 1000)
    _SCALE_NOTES = (
        "neither the scale of the voltages nor the current is published (5 mA is assumed): trust relative changes "
        "alone.",
        _POLARITY_NOTE,
        "voltages of driven electrodes are left out: they were not measured with care.",
    )

    @classmethod
    def recognises(cls, path: Path) -> bool:
        """Whether a file is an .eit file that begins with the number of a Swisstom format."""
        if path.suffix.lower() != ".eit":
            return False
        with path.open("rb") as file:
            first_bytes = file.read(4)
        return first_bytes in (
            bytes([cls._FORMAT, 0, 0, 0]),
            *(bytes([0, 0, 0, number]) for number in (1, 2, 3, cls._FORMAT)),
        )

    @classmethod
    def read(cls, path: Path, description: str | Path | None = None) -> Measurement:
        """Read all frames of a Swisstom recording. Raises `ValueError` for formats other than 4, for a file without a
        complete frame, and for damaged frames."""
        data = read_file_bytes(path)
        if data[:4] != bytes([cls._FORMAT, 0, 0, 0]):
            raise ValueError(
                f"{path.name} is of a Swisstom format that is not known; format 4 is. Export it as a table."
            )
        frames_start = int.from_bytes(data[4:8], "little", signed=True)
        if not 8 <= frames_start <= len(data):
            raise ValueError(f"{path.name}: its header says that frames begin at byte {frames_start}, beyond its end.")
        values, times, num_leftover_bytes = cls._frames(data, frames_start, path)
        if not values:
            raise ValueError(f"{path.name} holds no whole frame; is it cut off?")
        pairs = np.stack(values).astype(float) * cls._SCALE
        protocol = skip(cls._ELECTRODES, cls._SKIPPED, current=5e-3, driven_electrodes=True, order="fixed")
        recording = Recording(
            -(pairs[:, 0::2] + 1j * pairs[:, 1::2]),
            protocol,
            ~protocol.channels_on_driven_electrodes(),
            np.unwrap(times, period=cls._COUNTER_PERIOD) * 1e-6,
            notes=(*cls._SCALE_NOTES, *truncation_notes(num_leftover_bytes)),
        )
        return create_measurement(path, recording, find_or_load_description(path, description))

    @classmethod
    def _frames(cls, data: bytes, frames_start: int, path: Path) -> tuple[list[np.ndarray], np.ndarray, int]:
        """Stored numbers and times (microseconds) of every complete frame, and number of remaining bytes of a truncated
        last frame."""
        values, times, offset = [], [], frames_start
        while offset + cls._HEADER_BYTES <= len(data):
            kind, length = (int(number) for number in np.frombuffer(data, "<i4", 2, offset + 8))
            content_start = offset + cls._HEADER_BYTES
            if length < 0 or (kind == 0 and length < cls._VOLTAGE_OFFSET + 4 * cls._NUM_INTEGERS):
                raise ValueError(f"{path.name}: the frame at byte {offset} says a length of {length}; it is damaged.")
            if content_start + length > len(data):
                break
            if kind == 0:
                values.append(np.frombuffer(data, "<i4", cls._NUM_INTEGERS, content_start + cls._VOLTAGE_OFFSET))
                times.append(
                    int.from_bytes(
                        data[content_start + cls._TIME_OFFSET : content_start + cls._TIME_OFFSET + 4], "little"
                    )
                )
            offset = content_start + length
        return values, np.array(times, float), len(data) - offset
