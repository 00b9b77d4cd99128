"""A box between two plates that cover its opposite faces: the current is uniform."""


def plate_resistance(length: float, area: float, conductivity: complex, contact_impedance: complex) -> complex:
    """R = ℓ/(σA) + 2z/A, in ohm: Ohm's law, and one contact layer at each plate.

    In 3-D `area` is in m², `conductivity` in S/m, `contact_impedance` in ohm·m²; in 2-D `area` is the plate's
    length in metres, `conductivity` in siemens, `contact_impedance` in ohm·m.
    """
    return length / (conductivity * area) + 2.0 * contact_impedance / area
