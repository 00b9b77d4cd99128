"""Reader of the Kuopio Tomography Challenge 2023 (doi 10.5281/zenodo.8252370)."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from jeit.data.measurement import Measurement
from jeit.data.screening import screen
from jeit.electrodes import BoundaryElectrodes
from jeit.files import matlab
from jeit.layout import ring
from jeit.mesh import Disk
from jeit.protocol import from_matrices

DESCRIPTION = "Kuopio Tomography Challenge 2023 (.mat with Mpat, and Inj and Uel or Injref and Uelref)"
VARIABLES = (frozenset({"Mpat", "Inj", "Uel"}), frozenset({"Mpat", "Injref", "Uelref"}))
"""Variables of its files, and of the reference."""
RADIUS = 0.115
ELECTRODE_ANGLE = np.radians(5.625)
# Initial contact impedance for calibration, in ohm·m. A fit to the empty tank gives nearly zero.
CONTACT_IMPEDANCE = 0.01


def recognises(path: Path) -> bool:
    """Whether a file is a .mat file with the variables of the Kuopio Tomography Challenge 2023."""
    if path.suffix.lower() != ".mat":
        return False
    names = matlab.variable_names(path)
    return any(variables <= names for variables in VARIABLES)


def read(path: Path) -> Measurement:
    """Read one file of the challenge: one frame of 76 drives × 31 differences of neighbouring electrodes = 2,356
    channels, ordered drive by drive.

    NaN entries, from electrodes that are removed in the harder levels of the challenge, are masked. The tank has a
    radius of 0.115 m and 32 electrodes of 5.625°; electrode 1 is at 12 o'clock, and the other electrodes follow
    counter-clockwise. The current of each drive is its recorded amplitude.

    Raises `ValueError` for a file whose arrays have other shapes.
    """
    suffix = "" if "Inj" in matlab.variable_names(path) else "ref"
    keys = f"Inj{suffix}", f"Uel{suffix}", "Mpat"
    content = matlab.load(path, *keys)
    currents, voltages, differences = (matlab.numbers(content, key, path) for key in keys)
    num_electrodes, num_drives = currents.shape
    num_channels = num_drives * differences.shape[1]
    if differences.shape[0] != num_electrodes or voltages.size != num_channels:
        raise ValueError(
            f"{path.name}: {voltages.size} voltages, but {num_drives} drives and {differences.shape[1]} "
            f"measurement patterns make {num_channels}. Is the file damaged?"
        )
    protocol = from_matrices(
        1e-3 * currents.T,
        differences.T.astype(float),
        name=f"KTC 2023, {num_drives} drives, {differences.shape[1]} adjacent differences",
    )
    return screen(
        voltages.ravel(),
        protocol,
        electrodes=BoundaryElectrodes(ring(RADIUS, num_electrodes), RADIUS * ELECTRODE_ANGLE, CONTACT_IMPEDANCE),
        domain=Disk(RADIUS),
        name=path.stem,
        source=str(path),
        notes=("currents are assumed to be in milliamperes (about 1.4 in the file, without a unit).",),
    )
