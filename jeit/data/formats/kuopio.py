"""Readers of measurements of the tanks of the University of Eastern Finland, Kuopio: the KIT4 archive and the Kuopio
Tomography Challenge 2023.

The .mat files contain current patterns in milliamperes, differences of neighbouring electrodes, and one frame of
voltages. The readers add the tank, which the files do not describe.
"""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from jeit.data.measurement import Measurement
from jeit.data.screening import screen
from jeit.electrodes import BoundaryElectrodes
from jeit.files import matlab
from jeit.layout import ring
from jeit.mesh import Disk
from jeit.protocol import from_matrices


class _Tank(NamedTuple):
    """A tank with electrodes at equal distances, the first at 12 o'clock. **Fields**: `radius`, metres;
    `electrode_width`, metres; `contact_impedance`: initial value for calibration, in ohm·m; `is_clockwise`: whether the
    numbers of the electrodes increase clockwise."""

    radius: float
    electrode_width: float
    contact_impedance: float
    is_clockwise: bool


class Kit4:
    """Reader of the KIT4 tank archive (University of Eastern Finland, doi 10.5281/zenodo.1203914)."""

    DESCRIPTION = "KIT4 tank archive (.mat with Uel, CurrentPattern, MeasPattern)"
    VARIABLES = (frozenset({"Uel", "CurrentPattern", "MeasPattern"}),)
    """Variables that identify a file of the archive."""
    # Contact impedance: a fit to measurements of the empty tank yields about 1e-4 m / 1.3 mS.
    _ROUND_TANK = _Tank(0.14, 0.025, contact_impedance=0.08, is_clockwise=True)

    @classmethod
    def recognises(cls, path: Path) -> bool:
        """Whether a file is a .mat file with the three variables of the KIT4 archive."""
        return _has_variables(path, cls.VARIABLES)

    @classmethod
    def read(cls, path: Path) -> Measurement:
        """Read one file of the KIT4 archive: one frame of 79 drives × 16 differences of neighbouring electrodes = 1,264
        channels.

        Channels are ordered drive by drive. The 16 differences of a drive sum to zero, so 15 are independent; all 16
        are returned, including differences at driven electrodes (`Measurement.without_driven_channels` masks these
        channels). The tank has a radius of 0.14 m; electrode 1 is at 12 o'clock, and the other electrodes follow
        clockwise.

        Raises `ValueError` for a file whose arrays have other shapes.
        """
        variable_keys = "Uel", "CurrentPattern", "MeasPattern"
        file_variables = matlab.load(path, *variable_keys)
        voltages, drive_currents, measured_differences = (
            matlab.numbers(file_variables, variable_key, path) for variable_key in variable_keys
        )
        num_electrodes, num_drives = drive_currents.shape
        if measured_differences.shape[0] != num_electrodes or voltages.shape != (
            measured_differences.shape[1],
            num_drives,
        ):
            raise ValueError(
                f"{path.name}: Uel {voltages.shape} should be (measurements, drives) = "
                f"({measured_differences.shape[1]}, {num_drives}), as MeasPattern {measured_differences.shape} and "
                f"CurrentPattern {drive_currents.shape} say. Is the file damaged?"
            )
        return _screened_measurement(
            path,
            "KIT4",
            voltages.T.ravel(),
            drive_currents,
            measured_differences,
            cls._ROUND_TANK,
            measurement_notes=(
                "currents are assumed to be in milliamperes (±1.41421 in the file, without a unit).",
                f"electrodes are assumed to be {100 * cls._ROUND_TANK.electrode_width:.1f} cm wide, which fits the "
                "empty tank best.",
            ),
        )


class Ktc2023:
    """Reader of the Kuopio Tomography Challenge 2023 (doi 10.5281/zenodo.8252370)."""

    DESCRIPTION = "Kuopio Tomography Challenge 2023 (.mat with Mpat, and Inj and Uel or Injref and Uelref)"
    VARIABLES = (frozenset({"Mpat", "Inj", "Uel"}), frozenset({"Mpat", "Injref", "Uelref"}))
    """Variables that identify a file of the challenge, and a reference file."""
    # Contact impedance: a fit to measurements of the empty tank yields nearly zero.
    _ROUND_TANK = _Tank(0.115, 0.115 * np.radians(5.625), contact_impedance=0.01, is_clockwise=False)

    @classmethod
    def recognises(cls, path: Path) -> bool:
        """Whether a file is a .mat file with the variables of the Kuopio Tomography Challenge 2023."""
        return _has_variables(path, cls.VARIABLES)

    @classmethod
    def read(cls, path: Path) -> Measurement:
        """Read one file of the challenge: one frame of 76 drives × 31 differences of neighbouring electrodes = 2,356
        channels, ordered drive by drive.

        NaN entries, from electrodes that are removed in the harder levels of the challenge, are masked. The tank has a
        radius of 0.115 m and 32 electrodes of 5.625°; electrode 1 is at 12 o'clock, and the other electrodes follow
        counter-clockwise. The current of each drive is its recorded amplitude.

        Raises `ValueError` for a file whose arrays have other shapes.
        """
        variable_suffix = "" if "Inj" in matlab.variable_names(path) else "ref"
        variable_keys = f"Inj{variable_suffix}", f"Uel{variable_suffix}", "Mpat"
        file_variables = matlab.load(path, *variable_keys)
        drive_currents, voltages, measured_differences = (
            matlab.numbers(file_variables, variable_key, path) for variable_key in variable_keys
        )
        num_electrodes, num_drives = drive_currents.shape
        num_channels = num_drives * measured_differences.shape[1]
        if measured_differences.shape[0] != num_electrodes or voltages.size != num_channels:
            raise ValueError(
                f"{path.name}: {voltages.size} voltages, but {num_drives} drives and {measured_differences.shape[1]} "
                f"measurement patterns make {num_channels}. Is the file damaged?"
            )
        return _screened_measurement(
            path,
            "KTC 2023",
            voltages.ravel(),
            drive_currents,
            measured_differences,
            cls._ROUND_TANK,
            measurement_notes=("currents are assumed to be in milliamperes (about 1.4 in the file, without a unit).",),
        )


def _has_variables(path: Path, variable_sets: tuple[frozenset[str], ...]) -> bool:
    """Whether a file is a .mat file with all variables of one of the `variable_sets`."""
    if path.suffix.lower() != ".mat":
        return False
    variable_names = matlab.variable_names(path)
    return any(required_variables <= variable_names for required_variables in variable_sets)


def _screened_measurement(
    path: Path,
    name: str,
    voltages: Float[np.ndarray, " M"],
    drive_currents: Float[np.ndarray, "L D"],
    measured_differences: Float[np.ndarray, "L K"],
    round_tank: _Tank,
    measurement_notes: tuple[str, ...],
) -> Measurement:
    """Screen a frame of `voltages`, ordered drive by drive, with a protocol called `name` that consists of the
    `drive_currents` of D drives, in milliamperes, and K `measured_differences` of L electrodes."""
    protocol = from_matrices(
        1e-3 * drive_currents.T,
        measured_differences.T.astype(float),
        name=f"{name}, {drive_currents.shape[1]} drives, {measured_differences.shape[1]} adjacent differences",
    )
    electrode_positions = ring(round_tank.radius, len(drive_currents), clockwise=round_tank.is_clockwise)
    return screen(
        voltages,
        protocol,
        electrodes=BoundaryElectrodes(electrode_positions, round_tank.electrode_width, round_tank.contact_impedance),
        domain=Disk(round_tank.radius),
        name=path.stem,
        source=str(path),
        notes=measurement_notes,
    )
