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
_DRAEGER_HEADER_TEXT = b"---Draeger EIT-Software"
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
    _NUM_FRAME_BYTES: ClassVar = {0x20: 5200, 0x33: 5495}
    _NUM_PREFIX_BYTES = 16
    # Index of the first number of the second part of the voltages, and the weights of the two parts.
    _SECOND_PART_OFFSET, _PART_WEIGHTS = 322, (9.8242e-4, 1.9607e-4)
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
            return _DRAEGER_HEADER_TEXT in file.read(80)

    @classmethod
    def read(cls, path: Path, description: str | Path | None = None) -> Measurement:
        """Read all frames of a Dräger recording. Raises `ValueError` for an unknown version, a file without a complete
        frame, and a header without a frame rate."""
        file_bytes = read_file_bytes(path)
        format_version, header_length = (
            int(header_number) for header_number in np.frombuffer(file_bytes[:8].ljust(8, b"\0"), "<i4")
        )
        if format_version not in cls._NUM_FRAME_BYTES:
            known_versions = ", ".join(str(known_version) for known_version in cls._NUM_FRAME_BYTES)
            raise ValueError(
                f"{path.name} is of Dräger's format {format_version}; only {known_versions} are known. Export it as a "
                "table."
            )
        frames_start, frame_size = header_length + cls._NUM_PREFIX_BYTES, cls._NUM_FRAME_BYTES[format_version]
        num_frames, num_leftover_bytes = count_frames(file_bytes, frames_start, frame_size, path)
        frame_rate = cls._parse_frame_rate(file_bytes[:frames_start], path)
        frames = np.frombuffer(file_bytes, np.uint8, num_frames * frame_size, frames_start).reshape(
            num_frames, frame_size
        )
        stored_values = frames[:, : 8 * (cls._SECOND_PART_OFFSET + CHANNELS)].copy().view("<f8")
        first_part, second_part = stored_values[:, :CHANNELS], stored_values[:, cls._SECOND_PART_OFFSET :]
        with np.errstate(invalid="ignore", over="ignore"):
            voltages = cls._PART_WEIGHTS[0] * first_part - cls._PART_WEIGHTS[1] * second_part
        file_recording = adjacent_recording(
            voltages, np.arange(num_frames) / frame_rate, (*cls._SCALE_NOTES, *truncation_notes(num_leftover_bytes))
        )
        return create_measurement(path, file_recording, find_or_load_description(path, description))

    @staticmethod
    def _parse_frame_rate(header_bytes: bytes, path: Path) -> float:
        """Frame rate in frames per second, from the header."""
        rate_match = re.search(rb"Framerate \[Hz\]:[ \t]{0,40}([0-9]{1,6}(?:[.,][0-9]{1,6})?)", header_bytes)
        frame_rate = 0.0 if rate_match is None else float(rate_match[1].replace(b",", b"."))
        if not frame_rate > 0:
            raise ValueError(f"{path.name}: its header says no 'Framerate [Hz]:'; is it damaged?")
        return frame_rate


class Carefusion:
    """Reader of recordings by Carefusion's Goe-MF II (.eit): XML in UTF-16, followed by binary segments.

    `<Header>N bytes</Header>` states the offset of the first segment. A segment begins with six little-endian integers
    of four bytes: the type of the segment, a channel, the frame number counted from 0, the bytes per item, the number
    of items, and an integer of unknown meaning; the items follow. Type 3 is a frame of 256 numbers of four bytes; the
    208 numbers from the 48th on are the voltages of the adjacent protocol. Type 7 is an image of 912 numbers. Other
    types are waveforms.
    """

    DESCRIPTION = "Carefusion Goe-MF II (.eit): 208 adjacent voltages a frame"
    _BYTE_ORDER_MARK, _ROOT_TAG, _NUM_HEAD_BYTES = b"\xff\xfe", "<EIT_File>", 512
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
            return cls._ROOT_TAG in cls._decode_head(file.read(cls._NUM_HEAD_BYTES))

    @classmethod
    def read(cls, path: Path, description: str | Path | None = None) -> Measurement:
        """Read all frames of a Carefusion recording. Raises `ValueError` if the header does not state its length, and
        if there is no complete frame."""
        file_bytes = read_file_bytes(path)
        header_match = re.search(
            r"<Header>\s{0,9}([0-9]{1,9}) bytes</Header>", cls._decode_head(file_bytes[: cls._NUM_HEAD_BYTES])
        )
        if header_match is None or not cls._NUM_HEAD_BYTES // 8 < int(header_match[1]) < len(file_bytes):
            raise ValueError(f"{path.name}: its header does not say where the frames begin; is it damaged?")
        frames, num_leftover_bytes = cls._parse_frames(file_bytes, int(header_match[1]))
        if not frames:
            raise ValueError(f"{path.name} holds no whole frame; is it cut off?")
        sensor_description = find_or_load_description(path, description)
        rate_notes = (cls._NO_RATE_NOTE,) if sensor_description.layout.frame_rate is None else ()
        file_recording = adjacent_recording(
            np.stack(frames), None, (_SCALE_NOTE, *rate_notes, *truncation_notes(num_leftover_bytes))
        )
        return create_measurement(path, file_recording, sensor_description)

    @classmethod
    def _decode_head(cls, head_bytes: bytes) -> str:
        return (
            head_bytes[len(cls._BYTE_ORDER_MARK) :].decode("utf-16-le", "ignore")
            if head_bytes.startswith(cls._BYTE_ORDER_MARK)
            else ""
        )

    @classmethod
    def _parse_frames(cls, file_bytes: bytes, frames_start: int) -> tuple[list[np.ndarray], int]:
        """Voltages of every complete frame after byte `frames_start`, and number of remaining bytes of a truncated last
        segment."""
        frames, segment_offset = [], frames_start
        while segment_offset + 4 * cls._NUM_HEADER_INTEGERS <= len(file_bytes):
            segment_kind, _, _, item_size, num_items, _ = (
                int(header_integer)
                for header_integer in np.frombuffer(file_bytes, "<i4", cls._NUM_HEADER_INTEGERS, segment_offset)
            )
            segment_length = (
                4 * cls._SEGMENT_LENGTHS[segment_kind]
                if segment_kind in cls._SEGMENT_LENGTHS
                else max(item_size, 0) * max(num_items, 0)
            )
            content_start = segment_offset + 4 * cls._NUM_HEADER_INTEGERS
            if content_start + segment_length > len(file_bytes):
                return frames, len(file_bytes) - segment_offset
            if segment_kind == cls._VOLTAGE_SEGMENT:
                frames.append(np.frombuffer(file_bytes, "<f4", CHANNELS, content_start + 4 * cls._FIRST_VOLTAGE))
            segment_offset = content_start + segment_length
        return frames, len(file_bytes) - segment_offset


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
    _NUM_FRAME_BYTES, _HEADER_END, _MAX_RATE_TEXT_BYTES = 1024, b"\r\n\r\n\r\n", 65536
    # Bytes that occur in text; minimum fraction of finite numbers in a frame, and maximum magnitude of these numbers.
    _TEXT_BYTES, _MIN_FINITE_SHARE, _MAX_VALUE = frozenset(b"\t\r\n" + bytes(range(32, 127))), 0.9, 1e9
    _NO_RATE_NOTE = "the file says no rate, nor a record beside it (.prl); give it by [data] frame_rate."
    _RATE_PATTERN = re.compile(rb"Framerate\s*=\s*(\d+(?:\.\d+)?)\s*per second", re.IGNORECASE)

    @classmethod
    def recognises(cls, path: Path) -> bool:
        """Whether a file is a .get file that begins with Dräger's text, or whose first frame may be voltages: neither
        text nor numbers too large for any instrument."""
        if path.suffix.lower() != ".get":
            return False
        with path.open("rb") as file:
            first_bytes = file.read(cls._NUM_FRAME_BYTES)
        if first_bytes.startswith(_DRAEGER_HEADER_TEXT) or len(first_bytes) < cls._NUM_FRAME_BYTES:
            return True
        if all(head_byte in cls._TEXT_BYTES for head_byte in first_bytes):
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
        file_bytes, frames_start = read_file_bytes(path), 0
        if file_bytes.startswith(_DRAEGER_HEADER_TEXT):
            header_end = file_bytes.find(cls._HEADER_END, 0, cls._MAX_RATE_TEXT_BYTES)
            if header_end < 0:
                raise ValueError(
                    f"{path.name}: its text does not end with two empty lines before the frames; is it whole?"
                )
            frames_start = header_end + len(cls._HEADER_END)
        num_frames, num_leftover_bytes = count_frames(file_bytes, frames_start, cls._NUM_FRAME_BYTES, path)
        frame_voltages = np.frombuffer(file_bytes, "<f4", num_frames * cls._NUM_FRAME_BYTES // 4, frames_start).reshape(
            num_frames, -1
        )[:, :CHANNELS]
        sensor_description, frame_rate = find_or_load_description(path, description), cls._recorded_rate(path)
        rate_notes = (cls._NO_RATE_NOTE,) if frame_rate is None and sensor_description.layout.frame_rate is None else ()
        frame_times = None if frame_rate is None else np.arange(num_frames) / frame_rate
        return create_measurement(
            path,
            adjacent_recording(
                frame_voltages, frame_times, (_SCALE_NOTE, *rate_notes, *truncation_notes(num_leftover_bytes))
            ),
            sensor_description,
        )

    @classmethod
    def _recorded_rate(cls, path: Path) -> float | None:
        """Frame rate in frames per second from the .prl file beside a recording; None if there is no such file, or no
        rate in it."""
        for file_suffix in (".prl", ".PRL"):
            record_path = path.with_suffix(file_suffix)
            if record_path.is_file():
                with record_path.open("rb") as file:
                    rate_match = cls._RATE_PATTERN.search(file.read(cls._MAX_RATE_TEXT_BYTES))
                if rate_match and float(rate_match[1]) > 0:
                    return float(rate_match[1])
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
    _NUM_ELECTRODES, _NUM_SKIPPED_ELECTRODES, _FORMAT_NUMBER = 32, 4, 4
    # Number of bytes before the content of a frame, and in the content before the voltages; number of integers of the
    # voltages; offset of the time in the content.
    _NUM_HEADER_BYTES, _VOLTAGE_OFFSET, _NUM_INTEGERS, _TIME_OFFSET = 16, 60 + 12 + 256, 2 * _NUM_ELECTRODES**2, 16
    # Range of the four-byte counter of microseconds, after which it restarts at 0.
    _COUNTER_PERIOD = 2**32
    # Volts per unit of the stored numbers: an estimate by users of these files.
    _VOLTS_PER_STEP = 2.048 / (2**20 * 360 * 1000)
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
            bytes([cls._FORMAT_NUMBER, 0, 0, 0]),
            *(bytes([0, 0, 0, format_number]) for format_number in (1, 2, 3, cls._FORMAT_NUMBER)),
        )

    @classmethod
    def read(cls, path: Path, description: str | Path | None = None) -> Measurement:
        """Read all frames of a Swisstom recording. Raises `ValueError` for formats other than 4, for a file without a
        complete frame, and for damaged frames."""
        file_bytes = read_file_bytes(path)
        if file_bytes[:4] != bytes([cls._FORMAT_NUMBER, 0, 0, 0]):
            raise ValueError(
                f"{path.name} is of a Swisstom format that is not known; format 4 is. Export it as a table."
            )
        frames_start = int.from_bytes(file_bytes[4:8], "little", signed=True)
        if not 8 <= frames_start <= len(file_bytes):
            raise ValueError(f"{path.name}: its header says that frames begin at byte {frames_start}, beyond its end.")
        frame_integers, frame_times, num_leftover_bytes = cls._parse_frames(file_bytes, frames_start, path)
        if not frame_integers:
            raise ValueError(f"{path.name} holds no whole frame; is it cut off?")
        complex_parts = np.stack(frame_integers).astype(float) * cls._VOLTS_PER_STEP
        protocol = skip(
            cls._NUM_ELECTRODES, cls._NUM_SKIPPED_ELECTRODES, current=5e-3, driven_electrodes=True, order="fixed"
        )
        file_recording = Recording(
            -(complex_parts[:, 0::2] + 1j * complex_parts[:, 1::2]),
            protocol,
            ~protocol.channels_on_driven_electrodes(),
            np.unwrap(frame_times, period=cls._COUNTER_PERIOD) * 1e-6,
            notes=(*cls._SCALE_NOTES, *truncation_notes(num_leftover_bytes)),
        )
        return create_measurement(path, file_recording, find_or_load_description(path, description))

    @classmethod
    def _parse_frames(
        cls, file_bytes: bytes, frames_start: int, path: Path
    ) -> tuple[list[np.ndarray], np.ndarray, int]:
        """Stored numbers and times (microseconds) of every complete frame, and number of remaining bytes of a truncated
        last frame."""
        frame_integers, frame_microseconds, frame_offset = [], [], frames_start
        while frame_offset + cls._NUM_HEADER_BYTES <= len(file_bytes):
            frame_kind, frame_num_bytes = (
                int(header_number) for header_number in np.frombuffer(file_bytes, "<i4", 2, frame_offset + 8)
            )
            content_start = frame_offset + cls._NUM_HEADER_BYTES
            if frame_num_bytes < 0 or (
                frame_kind == 0 and frame_num_bytes < cls._VOLTAGE_OFFSET + 4 * cls._NUM_INTEGERS
            ):
                raise ValueError(
                    f"{path.name}: the frame at byte {frame_offset} says a length of {frame_num_bytes}; it is damaged."
                )
            if content_start + frame_num_bytes > len(file_bytes):
                break
            if frame_kind == 0:
                frame_integers.append(
                    np.frombuffer(file_bytes, "<i4", cls._NUM_INTEGERS, content_start + cls._VOLTAGE_OFFSET)
                )
                frame_microseconds.append(
                    int.from_bytes(
                        file_bytes[content_start + cls._TIME_OFFSET : content_start + cls._TIME_OFFSET + 4], "little"
                    )
                )
            frame_offset = content_start + frame_num_bytes
        return frame_integers, np.array(frame_microseconds, float), len(file_bytes) - frame_offset
