"""Solutions of the conductivity equation in closed form or by series: what the forward model is held to.

They are plain NumPy, and none knows of finite elements: agreement with the forward model is an agreement of
two methods.
All lengths in metres, currents in amperes, sheet conductivity in siemens; admittivities and contact
impedances may be complex.
"""
