"""Load calibration: estimate the load of a contact, in newtons, from its peak in an image, with its uncertainty.

The peak is modelled as a function of the load F,

peak = s exp(b ρ² + c ρ⁴) F / (F + F½),

where s, b, c and F½ are fitted, and ρ is the distance of the contact from the middle of the skin, divided by the skin's
radius. The peak rises with the load and saturates, as conductivity under pressure does, and is larger near the
electrodes. A calibration is valid for the indenter with which it was recorded, and for similar indenters: a wider
contact under the same load has a different peak.
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
_MIN_NUM_CONTACTS = 8
# Maximum ratio of a peak to the saturated peak s exp(b ρ² + c ρ⁴); closer to saturation, the peak does not determine
# the load.
_MAX_SATURATION = 0.98
# Maximum distance of a contact from the middle of the skin, and minimum width of the widest contact, both divided by
# the skin's radius.
_MAX_RELATIVE_DISTANCE, _MIN_RELATIVE_WIDTH = 10.0, 1e-3


class LoadEstimate(Module):
    """Estimated load of a contact.

    **Fields**: `force`: the load, newtons; `deviation`: its standard deviation, newtons.
    """

    force: float
    deviation: float


class LoadCalibration(Module):
    """Fitted relation between the loads of contacts and their peaks in images.

    **Fields**: `centre` (2,), `radius`: centre and radius of the skin, metres; `parameters` (4,): log s, b, c and log
    F½ in peak = s exp(b ρ² + c ρ⁴) F / (F + F½), for a load F at ρ radii from the centre; `covariance` (4, 4):
    covariance of the parameters; `sign`: sign of the peaks, 1 or -1; `scatter`: standard deviation of the logarithm of
    a peak about the curve; `loads`: minimum and maximum load of the calibrated contacts, newtons; `farthest`: maximum ρ
    of these contacts; `highest`: maximum ratio of their fitted peaks to the saturated peak s exp(b ρ² + c ρ⁴).

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
        """Fit the relation to the peaks of eight or more `contacts` (n) under known `loads` (n,), newtons.

        The contacts should lie at several places. The logarithms of the peaks are fitted by least squares. `radius`,
        `centre`: radius and centre of the skin, metres. Raises `ValueError` for fewer than eight contacts, loads that
        are not positive or all the same, peaks of both signs, and a curve that does not fit.
        """
        check_metres("radius", radius)
        check_kind("contacts", contacts, (list, tuple), "a list of them, one for each load")
        loads = real_array("loads", loads, "newtons, one for each contact")
        if len(contacts) < _MIN_NUM_CONTACTS or loads.shape != (len(contacts),):
            raise ValueError(
                f"contacts and loads: give {_MIN_NUM_CONTACTS} or more, one load for each; there are {len(contacts)} "
                f"contacts, and loads of shape {loads.shape}."
            )
        for contact_index, contact in enumerate(contacts):
            check_kind(f"contacts[{contact_index}]", contact, Contact, "a Contact, as of find_contacts")
        if not (np.isfinite(loads).all() and (loads > 0).all() and np.ptp(loads) > 0):
            raise ValueError("loads must be positive, in newtons, and not all the same.")
        contact_peaks = np.array([contact.peak for contact in contacts])
        if abs(np.sign(contact_peaks).sum()) != len(contact_peaks):
            raise ValueError("contacts: their peaks must all be of one sign, and none zero.")
        centre = real_array("centre", centre, "(x, y) in metres")
        if centre.shape != (2,) or not np.isfinite(centre).all():
            raise ValueError(f"centre must be (x, y) in metres, finite; it is {centre.tolist()}.")
        relative_distances = np.array([np.linalg.norm(contact.centroid - centre) for contact in contacts]) / radius
        max_contact_width = max(float(np.sqrt(contact.area)) for contact in contacts)
        if not (relative_distances.max() < _MAX_RELATIVE_DISTANCE and max_contact_width > _MIN_RELATIVE_WIDTH * radius):
            max_contact_distance_mm = 1e3 * radius * relative_distances.max()
            raise ValueError(
                f"radius is {1e3 * radius:g} mm, and contacts lie up to {max_contact_distance_mm:.3g} mm from the "
                "centre, and "
                f"are {1e3 * max_contact_width:.2g} mm wide; give the skin's radius, and its centre, in metres."
            )
        log_peaks = np.log(np.abs(contact_peaks))
        initial_parameters = np.array([log_peaks.max(), 0.0, 0.0, np.log(np.median(loads))])

        def log_peak_residuals(parameters):
            return _log_peak(parameters, relative_distances, loads) - log_peaks

        # Weak priors, each with the weight of a thousandth of a reading, for parameters that the places or loads of the
        # contacts do not determine.
        prior_weights = np.sqrt(1e-3) * np.array([0.0, 0.3, 0.3, 0.3])
        least_squares_result = least_squares(
            lambda parameters: np.concatenate(
                [log_peak_residuals(parameters), prior_weights * (parameters - initial_parameters)]
            ),
            initial_parameters,
        )
        if not least_squares_result.success:
            raise ValueError(f"contacts and loads: no curve fits them ({least_squares_result.message}).")
        log_peak_scatter = float(
            np.sqrt((log_peak_residuals(least_squares_result.x) ** 2).sum() / (len(loads) - len(initial_parameters)))
        )
        parameter_covariance = log_peak_scatter**2 * np.linalg.inv(
            least_squares_result.jac.T @ least_squares_result.jac
        )
        max_saturation = float((loads / (loads + np.exp(least_squares_result.x[3]))).max())
        load_range = float(loads.min()), float(loads.max())
        peak_sign = int(np.sign(contact_peaks[0]))
        return cls(
            centre,
            float(radius),
            least_squares_result.x,
            parameter_covariance,
            peak_sign,
            log_peak_scatter,
            load_range,
            float(relative_distances.max()),
            max_saturation,
        )

    def load(self, contact: Contact) -> LoadEstimate:
        """Estimate the load of a contact, newtons, and its standard deviation.

        The standard deviation includes the uncertainty of the parameters and the scatter of peaks about the curve, but
        no change of the skin since calibration. If all gains become g times as large, for example, so do the peaks.
        Raises `ValueError` for a peak above the calibrated peaks, where the curve does not determine the load, for a
        peak of the opposite sign, and for a contact farther from the centre than the calibrated contacts.
        """
        check_kind("contact", contact, Contact, "a Contact, as of find_contacts")
        if contact.peak * self.sign <= 0:
            raise ValueError(
                f"contact: its peak {describe(contact.peak)} is not {'positive' if self.sign > 0 else 'negative'}, as "
                "those calibrated are; it is no load. Give the finder the sign that it had for calibration."
            )
        relative_distance = float(np.linalg.norm(contact.centroid - self.centre)) / self.radius
        if relative_distance > self.farthest + 0.05:
            raise ValueError(
                f"contact is {1e3 * relative_distance * self.radius:.1f} mm from the middle, and calibrated "
                f"contacts reach {1e3 * self.farthest * self.radius:.1f} mm; calibrate with loads farther out."
            )
        log_scale, quadratic_coefficient, quartic_coefficient, log_half_saturation_load = self.parameters
        saturation = abs(contact.peak) / np.exp(
            log_scale + quadratic_coefficient * relative_distance**2 + quartic_coefficient * relative_distance**4
        )
        # A peak less than two standard deviations above the calibrated peaks is no evidence of a larger load.
        if saturation > min(self.highest * np.exp(2 * self.scatter), max(self.highest, _MAX_SATURATION)):
            raise ValueError(
                f"contact: its peak {describe(contact.peak)} is {saturation / self.highest:.2f} times the highest "
                f"that was calibrated there, by {self.loads[1]:g} N; calibrate with greater loads."
            )
        force = float(np.exp(log_half_saturation_load) * saturation / (1 - saturation))
        # Derivatives of log F with respect to log peak: 1 / (1 − saturation); with respect to log s, b and c: −1 / (1 −
        # saturation), times the derivative of log peak; with respect to log F½: 1.
        load_sensitivity = 1 / (1 - saturation)
        derivatives_of_log_load = np.array(
            [-load_sensitivity, -load_sensitivity * relative_distance**2, -load_sensitivity * relative_distance**4, 1.0]
        )
        log_load_variance = (
            derivatives_of_log_load @ self.covariance @ derivatives_of_log_load + (load_sensitivity * self.scatter) ** 2
        )
        return LoadEstimate(force, force * float(np.sqrt(log_load_variance)))


def _log_peak(parameters, relative_distances, loads):
    """Compute the logarithms of the peaks of contacts at the relative distances ρ = `relative_distances` under `loads`,
    newtons."""
    log_scale, quadratic_coefficient, quartic_coefficient, log_half_saturation_load = parameters
    return (
        log_scale
        + quadratic_coefficient * relative_distances**2
        + quartic_coefficient * relative_distances**4
        + np.log(loads / (loads + np.exp(log_half_saturation_load)))
    )
