"""Writers of instruments' file formats, written from the published descriptions and independent of the readers."""

import struct

import numpy as np


def adjacent_channels(number=16):
    """Drive and measurement pairs (electrodes from 0) of every channel, in the order of the Göttingen systems."""
    return [
        (drive, (drive + 1) % number, (drive + step) % number, (drive + step + 1) % number)
        for drive in range(number)
        for step in range(2, number - 1)
    ]


def adjacent_voltages(impedance, current=5e-3):
    """Positive voltages (208,): the current enters at the second electrode of a pair."""
    return np.array([current * (impedance[r] - impedance[s]) @ (np.eye(16)[q] - np.eye(16)[p])
                     for p, q, r, s in adjacent_channels()])  # fmt: skip


def write_draeger(path, frames, *, version=0x33, rate="20.000", cut=0):
    """Frames (F, 208), volts."""
    size = {0x20: 5200, 0x33: 5495}[version]
    text = f"---Draeger EIT-Software V1.30---\r\n\r\nDate: 1.1.2020\r\nFramerate [Hz]:  {rate}\r\n\r\n".encode()
    content = struct.pack("<ii", version, len(text)) + b"\0" * 8 + text
    for frame in frames:
        numbers = np.zeros(600)
        numbers[:208], numbers[322:530] = (frame + 1.9607e-4 * 7.0) / 9.8242e-4, 7.0
        content += numbers.astype("<f8").tobytes() + b"\x7f" * (size - 4800)
    path.write_bytes(content[: len(content) - cut])


def write_get(path, frames, *, text=False):
    """Frames (F, 208)."""
    begin = b"---Draeger EIT-Software---\r\n---Protocol Data----\r\n\r\nFrames:      10\r\n\r\n\r\n" if text else b""
    rest = np.ones((len(frames), 48))
    path.write_bytes(begin + np.hstack([frames, rest]).astype("<f4").tobytes())


def write_carefusion(path, frames):
    """Frames (F, 208), with an image and a waveform between them."""
    text = '<?xml version="1.0" ?>\r\n<EIT_File>\r\n<Header>{:05d} bytes</Header>\r\n</EIT_File>\r\n'
    length = 2 + 2 * len(text.format(0))
    content = b"\xff\xfe" + text.format(length).encode("utf-16-le")
    assert len(content) == length
    for number, frame in enumerate(frames):
        numbers = np.zeros(256, "<f4")
        numbers[47:255] = frame
        content += struct.pack("<6i", 3, 0, number, 4, 256, 0) + numbers.tobytes()
        content += struct.pack("<6i", 7, 0, number, 4, 912, 0) + np.ones(912, "<f4").tobytes()
        content += struct.pack("<6i", 8, 0, number, 8, 5, 0) + b"\1" * 40
    path.write_bytes(content)


def write_swisstom(path, impedances, microseconds, *, scale=2.048 / (2**20 * 360 * 1000)):
    """Frames of transfer impedances (F, 32, 32), complex; events follow the first frame."""
    content = struct.pack("<ii", 4, 64) + b"\0" * 56
    pairs = [(one, (one + 5) % 32) for one in range(32)]
    for number, (impedance, time) in enumerate(zip(impedances, microseconds, strict=True)):
        values = np.array([5e-3 * (impedance[r] - impedance[s]) @ (np.eye(32)[q] - np.eye(32)[p])
                           for p, q in pairs for r, s in pairs]) / scale  # fmt: skip
        both = np.stack([values.real, values.imag], axis=1).round().astype("<i4")
        head = np.zeros(15, "<u4")
        head[4] = time % 2**32
        body = head.tobytes() + b"\0" * 12 + np.zeros(64, "<i4").tobytes() + both.tobytes() + b"\0" * 20
        content += struct.pack("<qii", 1_600_000_000_000 + number, 0, len(body)) + body
        if number == 0:
            content += struct.pack("<qii", 1_600_000_000_000, 1, 4) + b"\2\0\0\0"
    path.write_bytes(content)


def write_sciospec(path, impedances, pairs, *, current=1e-3, header=18, date="2020.01.02. 10:00:00.250", spare=0):
    """One file of complex impedances (frequencies, L, L), with pairs numbered from 1 and `spare` more channels than
    electrodes."""
    count = impedances.shape[1]
    lines = [str(header), "2", "setup", date, "1000", "10000", "0", str(len(impedances)), str(current), "20.0", "0"]
    if header == 9:
        del lines[1], lines[-1]
    lines += ["1"] * (header - 2 - len(lines)) if header == 18 else []
    if header == 18:
        lines += ["MeasurementChannels: " + ",".join(str(one + 1) for one in range(count))]
        every = ",".join(str(one + 1) for one in range(count + spare))
        lines += ["MeasurementChannelsIndependentFromInjectionPattern: " + every]
    for first, second in pairs:
        lines.append(f"{first} {second}")
        for impedance in impedances:
            potentials = current * impedance @ (np.eye(count)[first - 1] - np.eye(count)[second - 1]) + 0.3
            potentials = np.concatenate([potentials, np.full(spare, 9.0)])
            lines.append("\t".join(f"{one.real:.9E}\t{one.imag:.9E}" for one in potentials))
    path.write_text("\n".join(lines) + "\n")
