"""Reader of the KIT4 tank archive (University of Eastern Finland, doi 10.5281/zenodo.1203914)."""

from __future__ import annotations

from pathlib import Path

from jeit.data.measurement import Measurement
from jeit.data.screening import screen
from jeit.electrodes import BoundaryElectrodes
from jeit.files import matlab
from jeit.layout import ring
from jeit.mesh import Disk
from jeit.protocol import from_matrices

DESCRIPTION = "KIT4 tank archive (.mat with Uel, CurrentPattern, MeasPattern)"
VARIABLES = (frozenset({"Uel", "CurrentPattern", "MeasPattern"}),)
"""Variables of its files."""
RADIUS = 0.14
ELECTRODE_WIDTH = 0.025
# Initial contact impedance for calibration, in ohm·m: a fit to the empty tank gives about 1e-4 m / 1.3 mS.
CONTACT_IMPEDANCE = 0.08


def recognises(path: Path) -> bool:
    """Whether a file is a .mat file with the three variables of the KIT4 archive."""
    return path.suffix.lower() == ".mat" and VARIABLES[0] <= matlab.variable_names(path)


def read(path: Path) -> Measurement:
    """Read one file of the KIT4 archive: one frame of 79 drives × 16 differences of neighbouring electrodes = 1,264
    channels.

    Channels are ordered drive by drive. The 16 differences of a drive sum to zero, so 15 are independent; all 16 are
    kept, including differences at driven electrodes (`Measurement.without_driven_channels` masks these channels). The
    tank has a radius of 0.14 m; electrode 1 is at 12 o'clock, and the other electrodes follow clockwise.

    Raises `ValueError` for a file whose arrays have other shapes.
    """
    keys = "Uel", "CurrentPattern", "MeasPattern"
    content = matlab.load(path, *keys)
    voltages, currents, differences = (matlab.numbers(content, key, path) for key in keys)
    num_electrodes, num_drives = currents.shape
    if differences.shape[0] != num_electrodes or voltages.shape != (differences.shape[1], num_drives):
        raise ValueError(
            f"{path.name}: Uel {voltages.shape} should be (measurements, drives) = ({differences.shape[1]}, "
            f"{num_drives}), as MeasPattern {differences.shape} and CurrentPattern {currents.shape} say. Is the "
            "file damaged?"
        )
    protocol = from_matrices(
        1e-3 * currents.T,
        differences.T.astype(float),
        name=f"KIT4, {num_drives} drives, {differences.shape[1]} adjacent differences",
    )
    return screen(
        voltages.T.ravel(),
        protocol,
        electrodes=BoundaryElectrodes(ring(RADIUS, num_electrodes, clockwise=True), ELECTRODE_WIDTH, CONTACT_IMPEDANCE),
        domain=Disk(RADIUS),
        name=path.stem,
        source=str(path),
        notes=(
            "currents are assumed to be in milliamperes (±1.41421 in the file, without a unit).",
            f"electrodes are assumed to be {100 * ELECTRODE_WIDTH:.1f} cm wide, which fits the empty tank best.",
        ),
    )
