"""Arrays of files that jeit writes: the protocol is read from them where no description states it, and faults of their
types are refused."""

import re

import numpy as np
import pytest

from jeit import data, protocol
from jeit.protocol import Protocol


@pytest.fixture
def written(tank, setup, tmp_path):
    """A measurement whose channels are in reverse order, and its file with a description that states no protocol."""
    base = protocol.adjacent(16)
    chosen = Protocol(
        base.drive, base.measurement, base.drive_index[::-1], base.measurement_index[::-1], name="reverse"
    )
    measurement = data.screen(np.asarray(tank(base))[::-1], chosen, **setup(16))
    path, description = data.write_table(measurement, tmp_path / "frames.npz")
    text = description.read_text("utf-8")
    description.write_text(re.sub(r"\[protocol\].*?(?=\[data\])", "", text, flags=re.DOTALL), "utf-8")
    return measurement, path


def test_the_protocol_is_read_from_the_arrays(written):
    measurement, path = written
    read = data.read(path)
    assert read.protocol.name == "reverse"
    np.testing.assert_array_equal(read.protocol.channel_drive, measurement.protocol.channel_drive)
    np.testing.assert_array_equal(read.voltages, measurement.voltages)


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"voltages": np.array([["a"] * 208])}, "'voltages' holds <U1; give numbers, in volts"),
        ({"times": np.array(["noon"])}, "'times' holds <U4; give seconds"),
    ],
)
def test_types_other_than_numbers_are_refused(written, changed, message):
    _, path = written
    with np.load(path) as arrays:
        content = dict(arrays)
    np.savez(path, **(content | changed))
    with pytest.raises(ValueError, match=message):
        data.read(path)


def test_gains_are_one_for_each_measurement(written):
    measurement, path = written
    description = path.with_suffix(".toml")
    text = description.read_text("utf-8")
    gains = np.linspace(0.9, 1.1, 16)
    description.write_text(text + f"gains = {gains.tolist()}\n", "utf-8")
    index = np.asarray(measurement.protocol.measurement_index)
    np.testing.assert_allclose(data.read(path).voltages, np.asarray(measurement.voltages) / gains[index])
    description.write_text(text + "gains = [1.0, 2.0]\n", "utf-8")
    with pytest.raises(ValueError, match=r"one for each of the 16 measurement patterns of 'reverse'; they are 2"):
        data.read(path)


def test_the_only_array_of_numbers_is_that_of_the_voltages(written):
    measurement, path = written
    with np.load(path) as arrays:
        content = dict(arrays)
    named = {("frames" if name == "voltages" else name): array for name, array in content.items()}
    np.savez(path, **named, rate=np.array(10.0), who=np.array(["me"] * 9))
    np.testing.assert_array_equal(data.read(path).voltages, measurement.voltages)
    np.savez(path, **named, others=np.zeros(208))
    with pytest.raises(ValueError, match=r"no array 'voltages'; the file has .*frames.* and .*\[data\] keys"):
        data.read(path)
