"""Localisation of the touches in a recording: detection of touches, and position and status of each frame."""

from __future__ import annotations

from typing import NamedTuple

import equinox as eqx
import jax
import numpy as np
from scipy.special import chdtrc, chdtri

from jeit.acoustic.calibration.calibration import Calibration, calibrated_intensities
from jeit.acoustic.localisation.array_changes import (
    GainChanges,
    covariance_with_gains,
    estimate_gain_changes,
    find_setup_changes,
)
from jeit.acoustic.localisation.localiser import Localiser, SourceEstimate
from jeit.acoustic.localisation.locations import MAX_NUMPY_FRAMES, Locations, LocationStatus
from jeit.acoustic.localisation.two_sources import locate_two
from jeit.acoustic.microphones import IntensityNoise, MicrophoneArray, noise_from_negative_powers
from jeit.acoustic.signal.faults import describe_faults
from jeit.acoustic.signal.intensity import IntensitySettings
from jeit.acoustic.signal.recording import Intensities, Recording
from jeit.acoustic.surface import longer_side
from jeit.arguments import describe, is_number
from jeit_solvers.engines import as_array, on_host

# Default standard deviation of the changes of the microphones' gains since the calibration, as a fraction of the
# intensities.
GAIN_DRIFT_DEVIATION = 0.1
# Probability that a silent frame is detected as a touch, and probability that a frame with one source is classified as
# a misfit.
_DETECTION_FALSE_ALARM_PROBABILITY, _FALSE_MISFIT_PROBABILITY = 1e-6, 1e-4
# Detection threshold of touches in standard deviations of the noise, if the distribution of the noise is unknown.
_DETECTION_DEVIATIONS_OF_NOISE = 6.0
# Thresholds of differences of −2 log-likelihood: a frame is "outside" if a position beyond the outline is better by
# more than 9 (three standard deviations).
_MIN_OUTSIDE_LIKELIHOOD_GAIN = 9.0
# A frame is "ambiguous" if its second valley is worse by less than 4 (two standard deviations).
_MAX_AMBIGUOUS_LIKELIHOOD_DIFFERENCE = 4.0
# Thresholds for accepting two sources whose misfit is statistically significant: maximum ratio of the misfit of two
# sources to that of one source, and maximum misfit per degree of freedom. Minimum ratio of the strengths of two
# sources, since errors of the decay models look like a weak second source.
_MAX_MISFIT_RATIO, _MAX_MISFIT, _MIN_STRENGTH_RATIO = 0.2, 10.0, 0.05
# Changes of the setup are searched for if one source on the skin fails to explain more than this fraction of the frames
# with a touch.
_MAX_UNEXPLAINED_FRAMES = 0.25
# Minimum fraction of the frames that one or two sources must explain if the gains have not changed.
_MIN_EXPLAINED_FRAMES = 0.9
# Minimum ratio of the intensity of a touch to the highest intensity of the recording, if no noise floor is known (−60
# dB).
_MIN_RELATIVE_INTENSITY = 1e-6
# Maximum plausible ratio of the strength of touches to that of the calibration taps, or its inverse (40 dB).
_MAX_PLAUSIBLE_STRENGTH_RATIO = 1e4


def locate(
    recording: Recording | Intensities,
    calibration: Calibration,
    *,
    method: str = "likelihood",
    map_shape: tuple[int, int] | None = None,
    intensity: IntensitySettings | None = None,
    silence: Recording | None = None,
    gain_drift: float = GAIN_DRIFT_DEVIATION,
    compiled: bool | None = None,
) -> Locations:
    """Locate the touch in each frame of a recording.

    **Arguments:**

    - `recording`: samples or intensities of the calibrated microphones.
    - `calibration`: the calibrated array.
    - `method`: "likelihood" (maximum likelihood), or "consistency" for the loss of Park 2022.
    - `map_shape`: (rows, columns) of the raster that is searched, (200, 200) in Park 2022; by default a coarse grid. In
      both cases, the best position is then refined.
    - `intensity`: frequency band and windows, for recordings of samples; by default as in the calibration.
    - `silence`: recording of the untouched array, from which the noise floor is estimated; required if touches never
      pause.
    - `gain_drift`: standard deviation of the changes of the microphones' gains since the calibration, as a fraction of
      the intensities. The changes are estimated from all touches of the recording, and the covariances of positions
      include the remaining errors of the gains. Use 0 if the gains have not changed.
    - `compiled`: whether to compile the computation, which takes seconds but then makes the computation several times
      faster; by default True for more than 1,024 frames with a touch. Use True for many successive recordings.

    Raises `ValueError` if the recording and the calibration have different numbers of microphones, if `gain_drift` is
    negative or not finite, and if fewer than three microphones can be used.

    **Example:**

    ```python
    locations = locate(recording, calibration)
    print(locations.counts())
    ```
    """
    if not (is_number(gain_drift) and gain_drift >= 0):
        raise ValueError(f"gain_drift must be zero or positive, as a fraction; it is {describe(gain_drift)}.")
    intensities = calibrated_intensities(recording, calibration, intensity, silence=silence)
    microphone_array, use, faults = microphones_in_use(intensities, calibration)
    has_touch = use.any(axis=1) & _detected_frames(intensities, microphone_array.noise, use)
    has_enough_readings = use.sum(axis=1) >= 3
    is_located = has_touch & has_enough_readings
    compiled = int(is_located.sum()) > MAX_NUMPY_FRAMES if compiled is None else compiled
    num_frames, dimension = len(intensities.times), calibration.microphone_array.microphones.shape[1]
    status = np.where(has_touch, LocationStatus.TOUCH, LocationStatus.NO_TOUCH).astype(object)
    status[~has_enough_readings] = LocationStatus.UNUSABLE
    locations = {
        "position": np.full((num_frames, dimension), np.nan),
        "covariance": np.full((num_frames, dimension, dimension), np.nan),
        "strength": np.full(num_frames, np.nan),
        "misfit": np.full(num_frames, np.nan),
        "freedom": np.zeros(num_frames, int),
        "second": np.full((num_frames, dimension), np.nan),
        "second_strength": np.full(num_frames, np.nan),
    }
    location_notes = list(intensities.notes)
    if is_located.any():
        location_settings = _LocationSettings(method, map_shape, gain_drift, compiled)
        frames_in_use = intensities.power[is_located], use[is_located]
        status[is_located], frame_results, gain_changes = _locate_frames(
            microphone_array, *frames_in_use, location_settings
        )
        for field_name, field_values in frame_results.items():
            locations[field_name][is_located] = field_values
        locations["covariance"] *= calibration.widening
        _limit_uncertainty(status, locations, float(longer_side(on_host(microphone_array.surface))))
        location_notes += [*_gain_note(gain_changes), *_setup_notes(status, intensities, use, microphone_array)]
    return Locations(
        np.asarray(intensities.times),
        **locations,
        status=status.astype(str),
        used=use,
        overlap=intensities.overlap,
        faults=faults,
        notes=(*location_notes, *_unit_note(locations["strength"], intensities, use, calibration)),
        name=intensities.name,
    )


class _LocationSettings(NamedTuple):
    """Arguments of `locate` that determine how the sources of frames are located."""

    method: str
    map_shape: tuple[int, int] | None
    gain_drift: float
    compiled: bool


def _locate_frames(
    microphone_array: MicrophoneArray, power: np.ndarray, use: np.ndarray, settings: _LocationSettings
) -> tuple[np.ndarray, dict[str, np.ndarray], GainChanges]:
    """Locate the sources of F frames with a touch. Returns the status (F,), a dictionary of the results by the names of
    the fields of `Locations`, and the gain changes with which the results were computed."""
    compiled, num_frames = settings.compiled, len(power)
    padded_frames = _pad_frames(power, use, compiled)

    def estimate_sources(
        changed_array: MicrophoneArray, method: str, map_shape: tuple[int, int] | None
    ) -> SourceEstimate:
        localiser = Localiser.create(changed_array, method=method, map_shape=map_shape, compiled=compiled)
        return jax.tree.map(lambda source_values: np.array(source_values)[:num_frames], localiser(*padded_frames))

    def locate_most_likely(changed_array: MicrophoneArray) -> tuple[SourceEstimate, np.ndarray]:
        likelihood_estimate = estimate_sources(changed_array, "likelihood", None)
        return likelihood_estimate, _initial_status(likelihood_estimate, likelihood_estimate) == LocationStatus.TOUCH

    *possible_changes, last_changes = estimate_gain_changes(
        microphone_array, power, use, settings.gain_drift, locate_most_likely
    )

    def locate_after_changes(gain_changes: GainChanges) -> tuple[np.ndarray, dict[str, np.ndarray]]:
        changed_array = gain_changes.apply(microphone_array)
        # The status of a frame is always determined from the likelihood, even if the position is estimated from the
        # consistency loss.
        likelihood_estimate, _ = locate_most_likely(changed_array)
        is_default_method = settings.method == "likelihood" and settings.map_shape is None
        more_likely_estimate = (
            likelihood_estimate
            if is_default_method
            else estimate_sources(changed_array, settings.method, settings.map_shape)
        )
        locations = {
            field_name: np.array(getattr(more_likely_estimate, field_name))
            for field_name in ("position", "covariance", "strength")
        }
        locations |= {
            field_name: np.array(getattr(likelihood_estimate, field_name)) for field_name in ("misfit", "freedom")
        }
        locations |= {
            "second": np.full_like(locations["position"], np.nan),
            "second_strength": np.full(num_frames, np.nan),
        }
        if settings.method == "likelihood":
            locations["covariance"] = covariance_with_gains(
                microphone_array, power, use, more_likely_estimate, gain_changes
            )
        status = _initial_status(likelihood_estimate, more_likely_estimate)
        _fit_two_sources(status, locations, power, use, changed_array, compiled)
        excess_cost = np.asarray(likelihood_estimate.excess)
        status[(status == LocationStatus.MISFIT) & (excess_cost > _MIN_OUTSIDE_LIKELIHOOD_GAIN)] = (
            LocationStatus.OUTSIDE
        )
        return status, locations

    for gain_changes in possible_changes:
        status, locations = locate_after_changes(gain_changes)
        if np.mean(status != LocationStatus.MISFIT) > _MIN_EXPLAINED_FRAMES:
            return status, locations, gain_changes
    return *locate_after_changes(last_changes), last_changes


def _initial_status(most_likely: SourceEstimate, source_estimate: SourceEstimate) -> np.ndarray:
    """Status of the frames with a touch, before a fit of two sources is tried. `most_likely`: maximum-likelihood
    estimates, which determine the status; `source_estimate`: estimates of the selected method."""
    misfit, degrees_of_freedom = np.asarray(most_likely.misfit), np.asarray(most_likely.freedom)
    excess_cost = np.asarray(most_likely.excess)
    has_rival = np.asarray(most_likely.rival) < _MAX_AMBIGUOUS_LIKELIHOOD_DIFFERENCE
    status = np.where(has_rival, LocationStatus.AMBIGUOUS, LocationStatus.TOUCH).astype(object)
    status[_exceeds_noise(misfit, degrees_of_freedom)] = LocationStatus.MISFIT
    # A frame is "outside" if a source beyond the outline explains its intensities, and does so clearly better than any
    # source inside. One source beyond the outline does not explain the intensities of two sources.
    status[(excess_cost > _MIN_OUTSIDE_LIKELIHOOD_GAIN) & ~_exceeds_noise(misfit - excess_cost, degrees_of_freedom)] = (
        LocationStatus.OUTSIDE
    )
    status[~np.isfinite(np.asarray(source_estimate.position)).all(axis=1)] = LocationStatus.UNUSABLE
    return status


def _exceeds_noise(misfit: np.ndarray, degrees_of_freedom: np.ndarray) -> np.ndarray:
    """Mask (F,) of the frames whose misfit noise alone does not explain."""
    return (degrees_of_freedom > 0) & (chdtrc(np.maximum(degrees_of_freedom, 1), misfit) < _FALSE_MISFIT_PROBABILITY)


def _fit_two_sources(
    status: np.ndarray,
    locations: dict[str, np.ndarray],
    power,
    use,
    microphone_array: MicrophoneArray,
    compiled: bool,
) -> None:
    """Fit two sources to the frames that one source does not explain, and enlarge the position covariances of the
    frames that two sources do not explain either. Modifies `status` and `locations` in place."""
    tried_frames = np.flatnonzero((status == LocationStatus.MISFIT) & (use.sum(axis=1) > 6))
    if tried_frames.size:
        two_sources = locate_two(
            microphone_array, *_pad_frames(power[tried_frames], use[tried_frames], compiled), compiled=compiled
        )
        misfit, degrees_of_freedom = (
            np.asarray(two_sources.misfit)[: tried_frames.size],
            np.asarray(two_sources.freedom)[: tried_frames.size],
        )
        stronger_strengths, weaker_strengths = np.asarray(two_sources.strength)[: tried_frames.size].T
        is_much_better = (misfit < _MAX_MISFIT_RATIO * locations["misfit"][tried_frames]) & (
            misfit < _MAX_MISFIT * degrees_of_freedom
        )
        is_accepted = (~_exceeds_noise(misfit, degrees_of_freedom) | is_much_better) & (
            weaker_strengths > _MIN_STRENGTH_RATIO * stronger_strengths
        )
        accepted_frames, accepted_indices = tried_frames[is_accepted], np.flatnonzero(is_accepted)
        status[accepted_frames] = LocationStatus.TWO_TOUCHES
        locations["misfit"][accepted_frames], locations["freedom"][accepted_frames] = (
            misfit[is_accepted],
            degrees_of_freedom[is_accepted],
        )
        pair_positions, pair_strengths = (
            np.asarray(two_sources.position)[accepted_indices],
            np.asarray(two_sources.strength)[accepted_indices],
        )
        locations["position"][accepted_frames], locations["second"][accepted_frames] = (
            pair_positions[:, 0],
            pair_positions[:, 1],
        )
        locations["strength"][accepted_frames], locations["second_strength"][accepted_frames] = pair_strengths.T
        locations["covariance"][accepted_frames] = np.asarray(two_sources.covariance)[accepted_indices, 0]
    misfit_frames = np.flatnonzero(status == LocationStatus.MISFIT)
    variance_factors = locations["misfit"][misfit_frames] / np.maximum(locations["freedom"][misfit_frames], 1)
    locations["covariance"][misfit_frames] *= np.maximum(variance_factors, 1.0)[:, None, None]


def _limit_uncertainty(status: np.ndarray, locations: dict[str, np.ndarray], skin_size: float) -> None:
    """Mark touches as ambiguous if the standard deviation of their position exceeds a fourth of the skin's size, and
    replace covariances whose standard deviation exceeds the skin's size. Modifies `status` and `locations` in place."""
    has_position = np.isfinite(locations["position"]).all(axis=1)
    is_finite = np.isfinite(locations["covariance"]).all(axis=(1, 2))
    position_deviation = np.zeros(len(status))
    position_deviation[is_finite] = np.sqrt(np.abs(np.linalg.eigvalsh(locations["covariance"][is_finite])).max(axis=1))
    is_uncertain = has_position & (status == LocationStatus.TOUCH) & (~is_finite | (position_deviation > skin_size / 4))
    status[is_uncertain] = LocationStatus.AMBIGUOUS
    deviation_exceeds_skin = has_position & (~is_finite | (position_deviation > skin_size))
    locations["covariance"][deviation_exceeds_skin] = (skin_size / 2) ** 2 * np.eye(locations["covariance"].shape[1])


def _gain_note(gain_changes: GainChanges) -> list[str]:
    """Note on the estimated changes of the microphones' gains; an empty list if no changes are applied."""
    gain_factors = np.exp(gain_changes.logarithm)
    if (gain_factors == 1).all():
        return []
    most_changed_microphone = int(np.abs(gain_changes.logarithm).argmax())
    return [
        "gains have changed since the calibration, and the places are corrected for it: most that of microphone "
        f"{most_changed_microphone}, by {100 * (gain_factors[most_changed_microphone] - 1):+.0f} % of its intensity."
    ]


def _setup_notes(
    status: np.ndarray, intensities: Intensities, use: np.ndarray, microphone_array: MicrophoneArray
) -> list[str]:
    """Notes on changes of the setup since the calibration. Such changes are searched for if there are many frames that
    one source does not explain."""
    setup_notes = []
    has_touch = ~np.isin(status, [LocationStatus.NO_TOUCH, LocationStatus.UNUSABLE])
    is_unexplained = np.isin(status, [LocationStatus.MISFIT, LocationStatus.OUTSIDE, LocationStatus.TWO_TOUCHES])
    if is_unexplained.sum() > _MAX_UNEXPLAINED_FRAMES * has_touch.sum():
        exchanged_pairs, altered_microphones = find_setup_changes(
            microphone_array, intensities.power[has_touch], use[has_touch]
        )
        setup_notes += [
            f"microphones {microphone} and {other_microphone} look exchanged since the calibration: exchanged back, "
            "their intensities fit one source. The places are not corrected: exchange the channels and locate again."
            for microphone, other_microphone in exchanged_pairs
        ]
        setup_notes += [
            f"microphone {microphone} does not measure as when it was calibrated: without it, one source explains the "
            "others. The places are not corrected: make its channel NaN and locate again, or calibrate anew."
            for microphone in altered_microphones
        ]
        if (
            not exchanged_pairs
            and not altered_microphones
            and (status == LocationStatus.MISFIT).sum() > 2 * _MAX_UNEXPLAINED_FRAMES * has_touch.sum()
        ):
            setup_notes.append("most touches fit no single source: is this the calibration of this array?")
    return setup_notes


def _unit_note(strength: np.ndarray, intensities: Intensities, use: np.ndarray, calibration: Calibration) -> list[str]:
    """Return a note if the intensities differ by orders of magnitude from the intensities of the calibration, which
    suggests a different gain or unit."""
    gain_and_unit_question = "do the recording and the taps have the same gain and unit?"
    if np.isfinite(strength).any():
        median_strength = float(np.nanmedian(strength))
        strength_ratio = median_strength / np.clip(
            median_strength, *(calibration.strengths or (median_strength, median_strength))
        )
        if max(strength_ratio, 1 / strength_ratio) > _MAX_PLAUSIBLE_STRENGTH_RATIO:
            return [
                f"touches are {strength_ratio:.3g} times as strong as the calibration's taps: {gain_and_unit_question}"
            ]
        return []
    # Without a touch and without a known noise floor, the intensities are compared with the noise of the calibration.
    noise_deviation = np.asarray(calibration.microphone_array.noise.deviation)
    has_noise = use.any(axis=0) & (noise_deviation > 0)
    if intensities.floor.any() or not has_noise.any():
        return []
    strength_ratio = float(
        np.median(np.where(use, np.abs(intensities.power), 0.0).max(axis=0)[has_noise] / noise_deviation[has_noise])
    )
    is_quiet = strength_ratio < 1 / _MAX_PLAUSIBLE_STRENGTH_RATIO
    return (
        [f"the sound is {strength_ratio:.3g} times as loud as the calibration's noise: {gain_and_unit_question}"]
        if is_quiet
        else []
    )


def microphones_in_use(
    intensities: Intensities, calibration: Calibration
) -> tuple[MicrophoneArray, np.ndarray, tuple[str, ...]]:
    """Return the calibrated microphone array with the noise of the `intensities`, the mask (F, M) of the usable
    intensities, and a description of the fault of each microphone.

    Raises `ValueError` if fewer than three microphones can be used.
    """
    use = np.asarray(intensities.usable) & calibration.usable
    faults = tuple(
        "; ".join(
            fault_text
            for fault_text in (fault, calibration_reason and f"not calibrated: {calibration_reason}")
            if fault_text
        )
        for fault, calibration_reason in zip(intensities.faults, calibration.reasons, strict=True)
    )
    if use.any(axis=0).sum() < 3:
        raise ValueError(
            f"'{intensities.name}': {use.any(axis=0).sum()} of {len(faults)} microphones can be used, and three are "
            f"needed to locate a touch. {describe_faults(faults)}."
        )
    calibrated_noise = calibration.microphone_array.noise
    if np.any(intensities.floor > 0):
        noise = IntensityNoise.create(
            len(faults),
            floor=intensities.floor,
            freedom=intensities.freedom,
            relative=np.asarray(calibrated_noise.relative),
        )
    else:
        # Negative intensities are due to noise, which may be larger in the recording than in the calibration.
        noise_deviation = np.maximum(
            noise_from_negative_powers(intensities.power, use), np.asarray(calibrated_noise.deviation)
        )
        noise = eqx.tree_at(
            lambda noise_to_change: (noise_to_change.deviation, noise_to_change.floor),
            calibrated_noise,
            (
                as_array(noise_deviation),
                as_array(
                    np.maximum(
                        calibrated_noise.floor,
                        IntensityNoise.create(len(noise_deviation), deviation=noise_deviation).floor,
                    )
                ),
            ),
        )
    return (
        eqx.tree_at(lambda microphone_array: microphone_array.noise, calibration.microphone_array, noise),
        use,
        faults,
    )


def _detected_frames(intensities: Intensities, noise: IntensityNoise, use: np.ndarray) -> np.ndarray:
    """Mask (F,) of the frames in which the intensity of at least one microphone exceeds the detection threshold of
    touches."""
    used_power = np.where(use, intensities.power, -np.inf)
    if np.any(intensities.floor > 0) and np.isfinite(intensities.freedom):
        detection_threshold = intensities.floor * (
            chdtri(intensities.freedom, _DETECTION_FALSE_ALARM_PROBABILITY / use.shape[1]) / intensities.freedom - 1
        )
    else:
        max_power = used_power.max(initial=0.0)
        detection_threshold = np.maximum(
            _DETECTION_DEVIATIONS_OF_NOISE * np.asarray(noise.deviation), _MIN_RELATIVE_INTENSITY * max_power
        )
    return np.asarray((used_power > detection_threshold).any(axis=1))


def _pad_frames(power: np.ndarray, use: np.ndarray, compiled: bool) -> tuple[np.ndarray, np.ndarray]:
    """Repeat the last frame up to a round number of frames if `compiled`, so that the program is compiled for few
    different numbers of frames."""
    if not compiled:
        return power, use
    num_frames = len(power)
    num_padded = max(64, 1 << (num_frames - 1).bit_length()) if num_frames <= 1024 else -(-num_frames // 1024) * 1024
    frame_indices = np.minimum(np.arange(num_padded), num_frames - 1)
    return power[frame_indices], use[frame_indices]
