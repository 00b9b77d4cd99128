"""Readers of the text that boards send over a serial line: Analog Devices' CN0565 kit and OpenEIT devices.

The last frame of a recording may be cut off, and is left out. Other frames in which characters were lost are masked, so
that the indices of later frames do not change.
"""

from __future__ import annotations

import itertools
import re
from array import array
from collections import Counter
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from jaxtyping import Bool, Complex, Float

from jeit.arguments import counted, names_text
from jeit.data.description import Description, parse_description
from jeit.data.formats.recording import Recording, create_measurement, find_or_load_description, read_file_bytes
from jeit.data.formats.table import description_like, find_description
from jeit.data.inferred_properties import correct_signs
from jeit.data.measurement import Measurement
from jeit.protocol import Protocol

# Amplitude in amperes where no description states the current.
_ASSUMED_CURRENT = 1e-3


class Cn0565:
    """Reader of recorded output of Analog Devices' CN0565 kit, which sends text over a serial line.

    A frame is a line that begins with "!V": integers of 32 bits in hexadecimal digits, separated by commas, alternately
    the real and the imaginary part of a voltage. For each electrode in turn, the current flows between this electrode
    and the electrode whose number differs by the force distance. For each drive, voltages are measured from each
    electrode in turn to the electrode whose number differs by the sense distance, except for pairs that contain a
    driven electrode. With 8, 16 or 32 electrodes and both distances 1, the default of the kit's programs, there are 40,
    208 or 928 voltages. Other lines are answers to commands and messages.
    """

    DESCRIPTION = "lines of Analog Devices' CN0565 kit ('!V' and hexadecimal numbers), of 8, 16 or 32 electrodes"
    # A terminal program may write the time before a frame.
    _FRAME_LINE_PATTERN = re.compile(rb"^[^!\r\n]{0,80}!V[ \t]{0,8}([0-9A-Fa-fxX, \t]*)(.*)$", re.MULTILINE)
    _HEXADECIMAL_PATTERN = re.compile(rb"(?:0[xX])?([0-9A-Fa-f]{1,8})")
    # Number of bytes read to recognise a file; minimum number of numbers in a frame.
    _NUM_HEAD_BYTES, _MIN_NUMBERS = 65536, 8
    _ELECTRODE_COUNTS = (8, 16, 32)
    _SCALE_NOTES = (
        "the numbers are those of the converter: neither their unit nor the current is known (1 mA is assumed): trust "
        "relative changes, not volts.",
    )
    _DISTANCE_HINT = (
        'with force and sense distance F and S it is kind = "skip", skipped = F - 1, measurement_skipped = S - 1, '
        'order = "fixed"'
    )

    @classmethod
    def recognises(cls, path: Path) -> bool:
        """Whether a file contains a frame of a CN0565 kit near its start."""
        with path.open("rb") as file:
            first_bytes = file.read(cls._NUM_HEAD_BYTES)
        return any(len(frame_numbers) >= cls._MIN_NUMBERS for frame_numbers in cls._parse_frame_lines(first_bytes))

    @classmethod
    def read(
        cls, path: Path, description: str | Path | None = None, like: Measurement | None = None, key: str | None = None
    ) -> Measurement:
        """Read all frames of a CN0565 recording. The section `[protocol]` of the description states the current, and
        distances other than 1; without a description, the body and the protocol are those of `like`, a measurement of
        the same sensor.

        Raises `ValueError` as `numbers` does, if no protocol is described and the number of voltages does not agree
        with distances of 1, and if a `key` is given, because the file contains no arrays.
        """
        _check_no_key(path, key)
        converter_steps, damage_notes = cls.numbers(path)
        described_measurement = _measurement_with_description(path, description, like)
        sensor_description = (
            find_or_load_description(path, description)
            if described_measurement is None
            else description_like(described_measurement)
        )
        protocol, protocol_notes = cls._choose_protocol(
            path, sensor_description, converter_steps.shape[1], described_measurement
        )
        sensor_description = replace(sensor_description, protocol_section=None)
        measurement = create_measurement(
            path,
            Recording(converter_steps, protocol, notes=(*cls._SCALE_NOTES, *protocol_notes, *damage_notes)),
            sensor_description,
        )
        return correct_signs(measurement, like)

    @classmethod
    def _choose_protocol(
        cls, path: Path, sensor_description: Description, num_voltages: int, similar_measurement: Measurement | None
    ) -> tuple[Protocol, tuple[str, ...]]:
        """The protocol of a recording with `num_voltages` voltages per frame, and notes on assumptions."""
        if similar_measurement is not None and similar_measurement.protocol.num_measurements == num_voltages:
            return similar_measurement.protocol, ()
        candidate_protocols = [
            protocol_and_options
            for protocol_and_options in sensor_description.protocols(path)
            if protocol_and_options[0].num_measurements == num_voltages
        ]
        if candidate_protocols:
            # For every drive, the kit measures in the order of electrode numbers, unless the description states a
            # different order.
            protocol, option_text = next(
                (
                    candidate_protocol
                    for candidate_protocol in candidate_protocols
                    if 'order = "fixed"' in candidate_protocol[1]
                ),
                candidate_protocols[0],
            )
            return protocol, (f"[protocol] {option_text} is taken, as the kit sends.",) if option_text else ()
        if sensor_description.protocol_section is not None:
            protocol = sensor_description.protocol(path)
            assert protocol is not None
            raise ValueError(
                f"{sensor_description.origin}: '{protocol.name}' has {protocol.num_measurements} channels, and a frame "
                f"of {path.name} {num_voltages}: {cls._DISTANCE_HINT}."
            )
        num_electrodes = next(
            (
                electrode_count
                for electrode_count in cls._ELECTRODE_COUNTS
                if electrode_count * (electrode_count - 3) == num_voltages
            ),
            None,
        )
        if num_electrodes is None:
            usual_counts_text = names_text(
                [
                    f"{electrode_count * (electrode_count - 3)} ({electrode_count} electrodes)"
                    for electrode_count in cls._ELECTRODE_COUNTS
                ]
            )
            raise ValueError(
                f"{path.name}: {num_voltages} voltages in a frame; with force and sense distance 1 they are "
                f"{usual_counts_text}. Give a description with [protocol]: {cls._DISTANCE_HINT}."
            )
        protocol_table: dict[str, Any] = {
            "kind": "adjacent",
            "number": num_electrodes,
            "order": "fixed",
            "current": _ASSUMED_CURRENT,
        }
        protocol = parse_description({"protocol": protocol_table}, path.name).protocol(path)
        assert protocol is not None
        return protocol, ("force and sense distance are taken to be 1 (adjacent pairs); the file does not say them.",)

    @classmethod
    def numbers(cls, path: Path) -> tuple[Complex[np.ndarray, "F M"], tuple[str, ...]]:
        """Return the voltages of each frame, in steps of the converter, and notes. Frames in which characters were
        lost, i.e. that are longer or shorter than most frames or have a cell that is not a number, are NaN.

        Raises `ValueError` if there is no frame, or if most frames have an odd number of numbers.
        """
        frames = list(cls._parse_frame_lines(read_file_bytes(path)))
        if not frames:
            raise ValueError(f"{path.name}: no line begins with '!V', as those of a CN0565 do.")
        frame_lengths = [len(frame) for frame in frames]
        frame_length = _usual_frame_length(frame_lengths)
        if frame_length % 2 or not frame_length:
            raise ValueError(
                f"{path.name}: most lines have {counted(frame_length, 'number')}; give real and imaginary parts in "
                "turn, an even number. Are lines cut off?"
            )
        damage_notes = []
        if len(frames) > 1 and frame_lengths[-1] < frame_length:
            damage_notes.append(_truncation_note(frame_lengths[-1]))
            del frames[-1]
        converter_steps = np.full((len(frames), frame_length), np.nan)
        for frame_index, frame in enumerate(frames):
            if len(frame) == frame_length and None not in frame:
                converter_steps[frame_index] = frame
        damage_notes += _notes_on_damage(np.isnan(converter_steps[:, 0]))
        return converter_steps[:, 0::2] + 1j * converter_steps[:, 1::2], tuple(damage_notes)

    @classmethod
    def _parse_frame_lines(cls, file_bytes: bytes) -> Iterator[list[float | None]]:
        """Yield the numbers of each line that is a frame; None for a cell that is not a number, and for text after the
        numbers."""
        for line in cls._FRAME_LINE_PATTERN.finditer(file_bytes):
            cells = [cell_text.strip() for cell_text in line[1].split(b",")]
            while cells and not cells[-1]:
                cells.pop()
            frame_numbers = [cls._parse_hexadecimal(cell_text) for cell_text in cells]
            yield [*frame_numbers, None] if line[2].strip() else frame_numbers
            for _ in range(line[2].count(b"!V")):  # a line end was lost; later frames keep their indices
                yield [None]

    @classmethod
    def _parse_hexadecimal(cls, cell_text: bytes) -> float | None:
        """The signed 32-bit integer in a cell of hexadecimal digits; None if the cell is not a number."""
        hexadecimal_match = cls._HEXADECIMAL_PATTERN.fullmatch(cell_text)
        if hexadecimal_match is None:
            return None
        unsigned_number = int(hexadecimal_match[1], 16)
        return float(unsigned_number - 2**32 if unsigned_number >= 2**31 else unsigned_number)


class OpenEit:
    """Reader of the text that OpenEIT devices send: the word "magnitudes" and the numbers of a frame, as OpenEIT's
    dashboard records them, with or without line ends.

    The count of numbers in a frame identifies the protocol of the firmware: 32, 192 or 896 for 8, 16 or 32 electrodes
    driven in opposite pairs, from every electrode; 928 for 32 electrodes driven in adjacent pairs; 28 for all pairs of
    8 electrodes, with the first device. Measurement pairs are adjacent, in the order of the electrodes. The numbers are
    magnitudes of impedances in ohms, and zero for an open circuit.
    """

    DESCRIPTION = "lines of an OpenEIT device ('magnitudes: …'), of 8, 16 or 32 electrodes"
    _FRAME_WORD_PATTERN = re.compile(rb"\s{0,40}magnitudes\s{0,40}:", re.IGNORECASE)
    _DECIMAL_NUMBER_PATTERN = re.compile(rb"\d{1,30}(?:\.\d{0,30})?(?:[eE][-+]?\d{1,3})?")
    # Number of bytes at the start that must contain the word "magnitudes", and number of bytes from which a file is
    # recognised.
    _NUM_WORD_SEARCH_BYTES, _NUM_HEAD_BYTES = 4096, 2_000_000
    # Section [protocol] for each protocol of the firmware, by number of channels.
    _PROTOCOL_TABLES: ClassVar[dict[int, dict[str, Any]]] = {
        **{
            channels: {"kind": "opposite", "number": count, "drives": "all", "order": "fixed"}
            for channels, count in ((32, 8), (192, 16), (896, 32))
        },
        928: {"kind": "adjacent", "number": 32, "order": "fixed"},
        28: {"kind": "two_terminal", "number": 8},
    }

    @classmethod
    def recognises(cls, path: Path) -> bool:
        """Whether a file has the word "magnitudes" near its start, and frames whose length belongs to a protocol of the
        OpenEIT firmware."""
        with path.open("rb") as file:
            first_bytes = file.read(cls._NUM_WORD_SEARCH_BYTES)
            first_word = cls._FRAME_WORD_PATTERN.search(first_bytes)
            if first_word is None:
                return False
            first_bytes += file.read(cls._NUM_HEAD_BYTES - len(first_bytes))
        return _usual_frame_length([len(frame) for frame in cls.parse_frames(first_bytes)]) in cls._PROTOCOL_TABLES

    @classmethod
    def read(
        cls, path: Path, description: str | Path | None = None, like: Measurement | None = None, key: str | None = None
    ) -> Measurement:
        """Read all frames of an OpenEIT recording. The section `[protocol]` of the description takes precedence over
        the firmware's protocol, which only determines options that the section does not state; without a description,
        the body is that of `like`, a measurement of the same sensor.

        Raises `ValueError` as `numbers` does, and if a `key` is specified, because the file contains no arrays.
        """
        _check_no_key(path, key)
        frame_voltages, damage_notes = cls.numbers(path)
        described_measurement = _measurement_with_description(path, description, like)
        sensor_description = (
            find_or_load_description(path, description)
            if described_measurement is None
            else description_like(described_measurement)
        )
        protocol_table = {**cls._PROTOCOL_TABLES[frame_voltages.shape[1]], "current": _ASSUMED_CURRENT}
        protocol = parse_description({"protocol": protocol_table}, path.name).protocol(path)
        assert protocol is not None
        for candidate_protocol, option_text in sensor_description.protocols(path):
            if cls._have_same_channels(candidate_protocol, protocol):
                protocol, sensor_description = candidate_protocol, replace(sensor_description, protocol_section=None)
                damage_notes = (
                    (*damage_notes, f"[protocol] {option_text} is taken, as the firmware sends.")
                    if option_text
                    else damage_notes
                )
                break
        if sensor_description.protocol_section is None and sensor_description.layout.scale == 1:
            drive_current = float(np.abs(np.asarray(protocol.drive)).max())
            frame_voltages = drive_current * frame_voltages
            damage_notes = (
                f"the numbers are taken for ohms, as of a calibrated device, times {1e3 * drive_current:g} mA.",
                *damage_notes,
            )
        file_recording = Recording(frame_voltages, protocol, notes=damage_notes)
        return correct_signs(create_measurement(path, file_recording, sensor_description), like)

    @staticmethod
    def _have_same_channels(first_protocol: Protocol, second_protocol: Protocol) -> bool:
        """Whether two protocols have the same channels, apart from the current."""
        if (
            first_protocol.num_electrodes != second_protocol.num_electrodes
            or first_protocol.num_measurements != second_protocol.num_measurements
        ):
            return False
        drive_signs = (np.sign(np.asarray(protocol.channel_drive)) for protocol in (first_protocol, second_protocol))
        measurement_signs = (np.asarray(protocol.channel_measurement) for protocol in (first_protocol, second_protocol))
        return all(
            (first_signs == second_signs).all() for first_signs, second_signs in (drive_signs, measurement_signs)
        )

    @classmethod
    def numbers(cls, path: Path) -> tuple[Float[np.ndarray, "F M"], tuple[str, ...]]:
        """Return the numbers of each frame of an OpenEIT recording, and notes. NaN replaces zero (an open circuit), a
        cell that is not a number, a last number that may be cut off, and all numbers of frames that are longer or
        shorter than most frames because characters were lost.

        Raises `ValueError` if the frames belong to no protocol of the firmware, or to two protocols.
        """
        file_bytes = read_file_bytes(path)
        frames = list(cls.parse_frames(file_bytes))
        frame_lengths = [len(frame) for frame in frames]
        frame_length = _usual_frame_length(frame_lengths)
        if not frames:
            raise ValueError(f"{path.name}: no frame begins with 'magnitudes:', as those of an OpenEIT device do.")
        if frame_length not in cls._PROTOCOL_TABLES:
            known_counts_text = names_text(
                [
                    f"{num_channels} ({protocol_table['number']} electrodes)"
                    for num_channels, protocol_table in cls._PROTOCOL_TABLES.items()
                ]
            )
            raise ValueError(
                f"{path.name}: most frames have {counted(frame_length, 'number')}; the firmware sends "
                f"{known_counts_text}. Read it as a table."
            )
        if other_frame_lengths := [
            channel_count
            for channel_count in cls._PROTOCOL_TABLES
            if channel_count != frame_length and frame_lengths.count(channel_count) > 1
        ]:
            raise ValueError(
                f"{path.name}: {frame_lengths.count(frame_length)} frames have {frame_length} numbers, and "
                f"{frame_lengths.count(other_frame_lengths[0])} have {other_frame_lengths[0]}: give the recordings of "
                "different devices in a file each."
            )
        damage_notes = []
        first_word = cls._FRAME_WORD_PATTERN.search(file_bytes)
        text_before_frames = (
            file_bytes[: first_word.start()].strip(b"\xef\xbb\xbf \r\n\t") if first_word is not None else b""
        )
        if text_before_frames:
            damage_notes.append(
                f"{counted(len(text_before_frames), 'character')} before the first 'magnitudes:' are left out."
            )
        if len(frames) > 1 and frame_lengths[-1] < frame_length:
            damage_notes.append(_truncation_note(frame_lengths[-1]))
            del frames[-1], frame_lengths[-1]
        elif file_bytes[-1:].isdigit() and frame_lengths[-1] == frame_length:
            frames[-1][-1] = np.nan
            damage_notes.append("nothing follows the last number, which may be cut off: masked.")
        # Frames between which the word "magnitudes" is lost appear as one long frame; its length shows the number of
        # lost frames, so that the indices of later frames do not change.
        frame_indices = np.cumsum(
            [0, *(max(1, round(frame_length_in_file / frame_length)) for frame_length_in_file in frame_lengths)]
        )
        is_complete_frame = np.zeros(frame_indices[-1], bool)
        is_complete_frame[
            [
                frame_index
                for frame_index, frame_length_in_file in zip(frame_indices[:-1], frame_lengths, strict=True)
                if frame_length_in_file == frame_length
            ]
        ] = True
        frame_voltages = np.full((len(is_complete_frame), frame_length), np.nan)
        frame_voltages[is_complete_frame] = [frame for frame in frames if len(frame) == frame_length]
        damage_notes += _notes_on_damage(~is_complete_frame)
        frame_voltages = np.where(frame_voltages == 0, np.nan, frame_voltages)
        if num_missing := int(np.isnan(frame_voltages[is_complete_frame]).sum()):
            damage_notes.append(
                f"{counted(num_missing, 'reading')} of zero, as of an open circuit, or illegible: masked."
            )
        return frame_voltages, tuple(damage_notes)

    @classmethod
    def parse_frames(cls, data: bytes) -> Iterator[array]:
        """Yield the numbers of each frame; NaN for a cell that is not a number. Empty cells, and words after the last
        number of a frame, are left out."""
        word_spans = [(word_match.start(), word_match.end()) for word_match in cls._FRAME_WORD_PATTERN.finditer(data)]
        for (_, frame_start), (frame_stop, _) in itertools.pairwise([*word_spans, (len(data), 0)]):
            cells = [cell_words.split() for cell_words in data[frame_start:frame_stop].split(b",")]
            cells = [cell_words for cell_words in cells if cell_words]
            while cells and not cells[-1][0][:1].isdigit():
                cells.pop()
            yield array(
                "d", (cls._parse_table_cell(cell_words, is_last=cell_words is cells[-1]) for cell_words in cells)
            )

    @classmethod
    def _parse_table_cell(cls, cell_words: list[bytes], *, is_last: bool) -> float:
        """The number in a cell of `cell_words`, NaN if the cell is not a number; words may follow the last number of a
        frame."""
        is_number = cls._DECIMAL_NUMBER_PATTERN.fullmatch(cell_words[0]) and (is_last or len(cell_words) == 1)
        cell_value = float(cell_words[0]) if is_number else np.nan
        return cell_value if np.isfinite(cell_value) else np.nan

    @classmethod
    def protocol_table(cls, path: Path) -> dict[str, Any]:
        """The section `[protocol]` of a description, without the current, for a file of OpenEIT."""
        return cls._PROTOCOL_TABLES[cls.numbers(path)[0].shape[1]]


def _check_no_key(path: Path, array_key: str | None) -> None:
    if array_key is not None:
        raise ValueError(f"key: {path.name} has no arrays to choose from; leave it out.")


def _measurement_with_description(
    path: Path, description: str | Path | None, similar_measurement: Measurement | None
) -> Measurement | None:
    """The measurement `similar_measurement`, whose description is used for a file if no description is specified and
    none lies beside the file, otherwise None."""
    return similar_measurement if description is None and find_description(path) is None else None


def _usual_frame_length(frame_lengths: list[int]) -> int:
    """Most common length of all frames except the last frame, which may be cut off."""
    return Counter(frame_lengths[:-1] or frame_lengths).most_common(1)[0][0] if frame_lengths else 0


def _truncation_note(truncated_length: int) -> str:
    return f"the last frame is cut off after {counted(truncated_length, 'number')}, and left out."


def _notes_on_damage(is_damaged: Bool[np.ndarray, " F"]) -> list[str]:
    """A note on the frames in which characters were lost; none without such frames."""
    frames = [str(frame_index) for frame_index in np.flatnonzero(is_damaged)]
    return [f"characters are lost in frame{'s' * (len(frames) > 1)} {names_text(frames)}: masked."] if frames else []
