"""Load calibration: estimate the load of a contact, in newtons, from its peak in an image, with its uncertainty.

The peak is modelled as a function of the load F,

peak = s exp(b ρ² + c ρ⁴) F / (F + F½),

where ρ is the distance of the contact from the middle of the skin, divided by the skin's radius. The peak rises with
the load and saturates, as conductivity under pressure does, and is larger near the electrodes. A calibration is valid
for one indenter, or similar ones: a wider contact under the same load has another peak.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike
from scipy.optimize import least_squares

from jeit.arguments import check_kind, check_metres, describe, real_array
from jeit.touch.contacts.finder import Contact
from jeit_solvers.module import Module

# Minimum number of contacts: one for each parameter s, b, c and F½, and four degrees of freedom for the scatter.
_FEWEST = 8
# Maximum ratio of a peak to the saturated peak; near saturation, the load is undetermined.
_HIGHEST = 0.98
# Divided by the skin's radius: maximum distance of a contact from the middle; minimum width of the widest contact.
_FARTHEST, _NARROWEST = 10.0, 1e-3


class Load(Module):
    """Estimated load of a contact.

    **Fields**: `force`: the load, newtons; `deviation`: its standard deviation, newtons.
    """

    force: float
    deviation: float


class LoadCalibration(Module):
    """Fitted relation between peaks and loads.

    **Fields**: `centre` (2,), `radius`: centre and radius of the skin, metres; `parameters` (4,): log s, b, c and log
    F½; `covariance` (4, 4): covariance of the parameters; `sign`: sign of the peaks, 1 or -1; `scatter`: standard
    deviation of the logarithm of a peak about the curve; `loads`: minimum and maximum load of the calibrated contacts,
    newtons; `farthest`: their maximum ρ; `highest`: their maximum ratio of a peak to the saturated peak.

    **Example:**

    ```python
    calibration = LoadCalibration.fit(known, loads, radius=0.05)
    print(calibration.load(known[0]).force)  # newtons
    ```
    """

    centre: Float[np.ndarray, "2"]
    radius: float
    parameters: Float[np.ndarray, "4"]
    covariance: Float[np.ndarray, "4 4"]
    sign: int
    scatter: float
    loads: tuple[float, float]
    farthest: float
    highest: float

    @classmethod
    def fit(
        cls, contacts: Sequence[Contact], loads: ArrayLike, *, radius: float, centre: ArrayLike = (0.0, 0.0)
    ) -> "LoadCalibration":
        """Fit the relation to at least eight `contacts` (n) under known `loads` (n,), newtons, at several places.

        The logarithms of the peaks are fitted by least squares. `radius`, `centre`: radius and centre of the skin,
        metres. Raises `ValueError` for fewer contacts, loads that are not positive or all the same, peaks of both
        signs, and a curve that does not fit.
        """
        check_metres("radius", radius)
        check_kind("contacts", contacts, (list, tuple), "a list of them, one for each load")
        loads = real_array("loads", loads, "newtons, one for each contact")
        if len(contacts) < _FEWEST or loads.shape != (len(contacts),):
            raise ValueError(
                f"contacts and loads: give {_FEWEST} or more, one load for each; there are {len(contacts)} "
                f"contacts, and loads of shape {loads.shape}."
            )
        for number, contact in enumerate(contacts):
            check_kind(f"contacts[{number}]", contact, Contact, "a Contact, as of find_contacts")
        if not (np.isfinite(loads).all() and (loads > 0).all() and np.ptp(loads) > 0):
            raise ValueError("loads must be positive, in newtons, and not all the same.")
        peaks = np.array([one.peak for one in contacts])
        if abs(np.sign(peaks).sum()) != len(peaks):
            raise ValueError("contacts: their peaks must all be of one sign, and none zero.")
        centre = real_array("centre", centre, "(x, y) in metres")
        if centre.shape != (2,) or not np.isfinite(centre).all():
            raise ValueError(f"centre must be (x, y) in metres, finite; it is {centre.tolist()}.")
        distance = np.array([np.linalg.norm(one.centroid - centre) for one in contacts]) / radius
        widest = max(float(np.sqrt(one.area)) for one in contacts)
        if not (distance.max() < _FARTHEST and widest > _NARROWEST * radius):
            most = 1e3 * radius * distance.max()
            raise ValueError(
                f"radius is {1e3 * radius:g} mm, and contacts lie up to {most:.3g} mm from the centre, and are "
                f"{1e3 * widest:.2g} mm wide; give the skin's radius, and its centre, in metres."
            )
        logarithm = np.log(np.abs(peaks))
        begin = np.array([logarithm.max(), 0.0, 0.0, np.log(np.median(loads))])

        def residuals(parameters):
            return _log_peak(parameters, distance, loads) - logarithm

        # Weak priors, each with the weight of a thousandth of a reading, for parameters that places or loads do not
        # determine.
        weak = np.sqrt(1e-3) * np.array([0.0, 0.3, 0.3, 0.3])
        found = least_squares(
            lambda parameters: np.concatenate([residuals(parameters), weak * (parameters - begin)]), begin
        )
        if not found.success:
            raise ValueError(f"contacts and loads: no curve fits them ({found.message}).")
        scatter = float(np.sqrt((residuals(found.x) ** 2).sum() / (len(loads) - len(begin))))
        covariance = scatter**2 * np.linalg.inv(found.jac.T @ found.jac)
        highest = float((loads / (loads + np.exp(found.x[3]))).max())
        span = float(loads.min()), float(loads.max())
        sign = int(np.sign(peaks[0]))
        return cls(centre, float(radius), found.x, covariance, sign, scatter, span, float(distance.max()), highest)

    def load(self, contact: Contact) -> Load:
        """Estimate the load of a contact, newtons, and its standard deviation.

        The standard deviation includes the uncertainty of the parameters and the scatter of peaks about the curve, but
        no change of the skin since calibration: if all gains are g times as large, so are peaks. Raises `ValueError`
        for a peak above the calibrated ones, where the curve does not determine the load, for a peak of the other sign,
        and for a contact farther from the centre than the calibrated ones.
        """
        check_kind("contact", contact, Contact, "a Contact, as of find_contacts")
        if contact.peak * self.sign <= 0:
            raise ValueError(
                f"contact: its peak {describe(contact.peak)} is not {'positive' if self.sign > 0 else 'negative'}, as "
                "those calibrated are; it is no load. Give the finder the sign that it had for calibration."
            )
        distance = float(np.linalg.norm(contact.centroid - self.centre)) / self.radius
        if distance > self.farthest + 0.05:
            raise ValueError(
                f"contact is {1e3 * distance * self.radius:.1f} mm from the middle, and calibrated contacts reach "
                f"{1e3 * self.farthest * self.radius:.1f} mm; calibrate with loads farther out."
            )
        scale, first, second, half = self.parameters
        share = abs(contact.peak) / np.exp(scale + first * distance**2 + second * distance**4)
        # A peak less than two standard deviations above the calibrated ones is no evidence of a larger load.
        if share > min(self.highest * np.exp(2 * self.scatter), max(self.highest, _HIGHEST)):
            raise ValueError(
                f"contact: its peak {describe(contact.peak)} is {share / self.highest:.2f} times the highest that was "
                f"calibrated there, by {self.loads[1]:g} N; calibrate with greater loads."
            )
        force = float(np.exp(half) * share / (1 - share))
        # Derivatives of log F with respect to log peak: 1 / (1 − share); with respect to log s, b and c: minus that,
        # times the derivative of log peak; with respect to log F½: 1.
        steep = 1 / (1 - share)
        slope = np.array([-steep, -steep * distance**2, -steep * distance**4, 1.0])
        variance = slope @ self.covariance @ slope + (steep * self.scatter) ** 2
        return Load(force, force * float(np.sqrt(variance)))


def _log_peak(parameters, distance, loads):
    """Logarithms of the peaks of contacts at distances ρ under loads in newtons."""
    scale, first, second, half = parameters
    return scale + first * distance**2 + second * distance**4 + np.log(loads / (loads + np.exp(half)))
