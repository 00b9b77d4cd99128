from .box import face_patch_impedance, plate_resistance
from .curved_sheets import sleeve_sheet_impedance, sphere_sheet_impedance
from .cylinder import ConductingCylinder, wall_patch_impedance
from .rim import (
    ConductingDisk,
    arc_transfer_impedance,
    logarithm_moments,
    point_inclusion_effect,
    point_potentials,
    point_transfer_impedance,
)
from .sheet_discs import centre_to_rim_resistance, disc_contact_resistance, disc_transfer_impedance
from .sphere import ConductingSphere, cap_impedance

__all__ = [
    "ConductingCylinder",
    "ConductingDisk",
    "ConductingSphere",
    "arc_transfer_impedance",
    "cap_impedance",
    "centre_to_rim_resistance",
    "disc_contact_resistance",
    "disc_transfer_impedance",
    "face_patch_impedance",
    "logarithm_moments",
    "plate_resistance",
    "point_inclusion_effect",
    "point_potentials",
    "point_transfer_impedance",
    "sleeve_sheet_impedance",
    "sphere_sheet_impedance",
    "wall_patch_impedance",
]
