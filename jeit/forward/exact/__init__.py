"""Solutions of the conductivity equation in closed form or by series: what the forward model is held to.

They are plain NumPy, and none knows of finite elements: agreement with the forward model is an agreement of
two methods.
All lengths in metres, currents in amperes, sheet conductivity in siemens; admittivities and contact
impedances may be complex.
"""

from jeit.forward.exact.arcs import arc_transfer_impedance as arc_transfer_impedance
from jeit.forward.exact.arcs import logarithm_moments as logarithm_moments
from jeit.forward.exact.box import plate_resistance as plate_resistance
from jeit.forward.exact.disk import ConductingDisk as ConductingDisk
from jeit.forward.exact.disk import point_inclusion_effect as point_inclusion_effect
from jeit.forward.exact.disk import point_potentials as point_potentials
from jeit.forward.exact.disk import point_transfer_impedance as point_transfer_impedance
from jeit.forward.exact.sheet_discs import centre_to_rim_resistance as centre_to_rim_resistance
from jeit.forward.exact.sheet_discs import disc_contact_resistance as disc_contact_resistance
from jeit.forward.exact.sheet_discs import disc_transfer_impedance as disc_transfer_impedance
