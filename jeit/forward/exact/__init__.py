"""Solutions of the conductivity equation in closed form or by series: what the forward model is held to.

They are plain NumPy, and none knows of finite elements: agreement with the forward model is an agreement of
two methods.
All lengths in metres, currents in amperes, sheet conductivity in siemens, that of solids in siemens per metre;
admittivities and contact impedances may be complex.
"""

from __future__ import annotations

from jeit.forward.exact.arcs import arc_transfer_impedance, logarithm_moments
from jeit.forward.exact.box import face_patch_impedance, plate_resistance
from jeit.forward.exact.curved_sheets import sleeve_sheet_impedance, sphere_sheet_impedance
from jeit.forward.exact.cylinder import ConductingCylinder, wall_patch_impedance
from jeit.forward.exact.disk import ConductingDisk, point_inclusion_effect, point_potentials, point_transfer_impedance
from jeit.forward.exact.sheet_discs import centre_to_rim_resistance, disc_contact_resistance, disc_transfer_impedance
from jeit.forward.exact.sphere import ConductingSphere, cap_impedance

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
