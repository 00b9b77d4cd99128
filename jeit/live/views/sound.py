"""View of an array of microphones: the map of the localisation loss of a frame of intensities, and the position of the
touch."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from jeit.acoustic import Calibration, Intensities, Localiser, locate
from jeit.acoustic.localisation.locate import microphones_in_use
from jeit.acoustic.localisation.locations import LocationStatus
from jeit.acoustic.surface import bounding_box
from jeit.inverse.streaming.stream import FrameStatus
from jeit.live.pictures import AbstractView, LiveFrame, Marker, Picture, Scene
from jeit.live.views.conductivity import mean_frame

# Number of pixels along the longer side of the map.
_NUM_PIXELS = 100
# Radius that contains 68 % of an isotropic normal distribution of standard deviation 1.
_RADIUS_OF_68_PERCENT = float(np.sqrt(-2 * np.log(1 - 0.68)))
_LIKELIHOOD = "likelihood"


class SoundView(AbstractView):
    """View of the loss map and the position of a touch, from frames with the intensity of each microphone.

    Positions are estimated by `jeit.acoustic.locate` with fixed gains, because changes of gains can be estimated only
    from all touches of a recording. With the method "likelihood", pixels are distances from the most likely position in
    standard deviations, √(2 (loss − minimum loss)), where the loss is the negative log-likelihood; with "consistency",
    pixels are the loss of Park et al. (2022).

    **Arguments:**

    - `calibration`: calibration of the array.
    - `method`: "likelihood" or "consistency".
    - `floor`: noise power (microphones,) that was subtracted from the intensities.
    - `freedom`: degrees of freedom of the noise power, as in `jeit.acoustic.Intensities`.

    Raises `ValueError` for any other method, for a `floor` with a different number of microphones, and for fewer than
    three usable microphones.

    **Example:**

    ```python
    sounds = SoundView(microphones)
    print(sounds.picture(LiveFrame(0, 0.0, 0.0, np.ones(9))).markers)
    ```
    """

    def __init__(
        self,
        calibration: Calibration,
        *,
        method: str = _LIKELIHOOD,
        floor: Float[np.ndarray, " M"] | None = None,
        freedom: float = np.inf,
    ):
        self.calibration, self.method = calibration, method
        self.floor, self.freedom = floor, freedom
        self._silent_power = np.zeros(calibration.num_microphones)
        array, _, _ = microphones_in_use(self._to_intensities(self._silent_power, 0.0), calibration)
        low, high = (np.asarray(corner, float) for corner in bounding_box(array.surface))
        size = (high - low).max() / _NUM_PIXELS
        columns, rows = (max(2, round(side / size)) for side in (high - low).tolist())
        self._localiser = Localiser.create(array, method=method, map_shape=(rows, columns), compiled=False)
        outline = np.asarray(array.surface.outline.loops()[0])
        positions = np.asarray(array.surface.project(array.microphones.T)).T
        names = [str(number) for number in range(1, len(positions) + 1)]
        is_likelihood_method = method == _LIKELIHOOD
        (x_min, y_min), (x_max, y_max) = low.tolist(), high.tolist()
        self.scene = Scene(
            title=f"Touches located by {len(positions)} microphones, {calibration.name}",
            quantity="distance from the most likely place" if is_likelihood_method else "loss",
            unit="σ" if is_likelihood_method else "",
            diverging=False,
            extent=(x_min, x_max, y_min, y_max),
            outline=[np.concatenate([outline, outline[:1]])],
            electrodes=[position[None] for position in positions],
            names=names,
            channels=names,
            notes=("A ring holds the place with a probability of 68 %.",),
        )

    def picture(self, frame: LiveFrame) -> Picture:
        """Compute the loss map of a frame with the position of the touch; see `AbstractView.picture`."""
        values = frame.values
        if isinstance(values, str) or values.shape != self._silent_power.shape:
            content_text = "text" if isinstance(values, str) else f"of {len(values)} numbers"
            reason = f"The frame is {content_text}, not {len(self._silent_power)} intensities."
            return Picture(None, status=FrameStatus.REFUSED, reason=reason)
        try:
            intensities = self._to_intensities(values - self._silent_power, frame.second)
            locations = locate(intensities, self.calibration, method=self.method, gain_drift=0.0, compiled=False)
        except ValueError as error:
            return Picture(None, status=FrameStatus.REFUSED, reason=str(error))
        status = locations.status[0]
        if status == LocationStatus.UNUSABLE:
            return Picture(None, status=FrameStatus.REFUSED, reason="Fewer than three microphones can be used.")
        if status == LocationStatus.NO_TOUCH:
            return Picture(None, status=FrameStatus.UNCHANGED)
        loss = np.asarray(self._localiser.maps(intensities.power, locations.used))[0, ::-1]
        if self.method == _LIKELIHOOD:
            loss = np.sqrt(2 * (loss - np.nanmin(loss)))
        reason = "" if status == LocationStatus.TOUCH else f"{status}: see the statuses of jeit locate.".capitalize()
        return Picture(loss.astype(np.float32), self._touch_markers(locations), reason=reason)

    def set_reference(self, frames: Float[np.ndarray, "N M"]) -> None:
        """Take the mean of `frames` (frames, microphones) without a touch as the intensity of silence, which is
        subtracted from later frames.

        Raises `ValueError` if the number of microphones differs from that of the calibration, and if a calibrated
        microphone has no reading.
        """
        mean = mean_frame(frames)
        if mean.shape != self._silent_power.shape or not np.isfinite(mean[self.calibration.usable]).all():
            raise ValueError(f"reference: give intensities of all {len(self._silent_power)} microphones.")
        self._silent_power = np.where(np.isfinite(mean), mean, 0.0)

    def _to_intensities(self, power: Float[np.ndarray, " M"], time: float) -> Intensities:
        usable = np.isfinite(power)[None]
        return Intensities(
            [time],
            power[None],
            floor=self.floor,
            freedom=self.freedom,
            usable=usable,
            faults=[""] * len(power),
            name="live",
        )

    def _touch_markers(self, locations) -> tuple[Marker, ...]:
        """Markers of the touch, and of the second touch if there are two."""
        project = self._localiser.microphone_array.surface.project
        deviation = float(np.sqrt(np.trace(locations.covariance[0]) / 2))
        positions_and_radii = [
            (locations.position[0], _RADIUS_OF_68_PERCENT * deviation),
            (locations.second[0], float("nan")),
        ]
        return tuple(
            Marker(*np.asarray(project(position[:, None]))[:, 0].tolist(), radius=radius)
            for position, radius in positions_and_radii
            if np.isfinite(position).all()
        )
