"""View of microphones: the loss map of a frame of intensities, and the place of the touch."""

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

# Pixels along the longer side of the map; radius that holds 68 % of a round normal distribution of deviation 1.
_PIXELS, _RADIUS = 100, float(np.sqrt(-2 * np.log(1 - 0.68)))
_LIKELIHOOD = "likelihood"


class SoundView(AbstractView):
    """Loss map and place of a touch, from the intensities of microphones: a frame is an intensity for each.

    Places are those of `jeit.acoustic.locate` without changes of gains, which it estimates from all touches of a
    recording. With the method "likelihood" pixels are distances from the most likely place, in standard deviations: √(2
    (loss − least loss)); with "consistency", the loss of Park et al. (2022).

    **Arguments:**

    - `calibration`: calibration of the array.
    - `method`: "likelihood" or "consistency".
    - `floor`: noise power (M,) that was subtracted from the intensities.
    - `freedom`: degrees of freedom of the noise power, as in `jeit.acoustic.Intensities`.

    Raises `ValueError` for another method, another number of microphones, or fewer than three that can be used.

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
        self._silence = np.zeros(calibration.num_microphones)
        array, _, _ = microphones_in_use(self._intensities(self._silence, 0.0), calibration)
        low, high = (np.asarray(one, float) for one in bounding_box(array.surface))
        size = (high - low).max() / _PIXELS
        columns, rows = (max(2, round(side / size)) for side in (high - low).tolist())
        self._localiser = Localiser.create(array, method=method, map_shape=(rows, columns), compiled=False)
        edge = np.asarray(array.surface.outline.loops()[0])
        places = np.asarray(array.surface.project(array.microphones.T)).T
        names = [str(one) for one in range(1, len(places) + 1)]
        likely = method == _LIKELIHOOD
        (x_min, y_min), (x_max, y_max) = low.tolist(), high.tolist()
        self.scene = Scene(
            title=f"Touches located by {len(places)} microphones, {calibration.name}",
            quantity="distance from the most likely place" if likely else "loss",
            unit="σ" if likely else "",
            diverging=False,
            extent=(x_min, x_max, y_min, y_max),
            outline=[np.concatenate([edge, edge[:1]])],
            electrodes=[place[None] for place in places],
            names=names,
            channels=names,
            notes=("A ring holds the place with a probability of 68 %.",),
        )

    def picture(self, frame: LiveFrame) -> Picture:
        """The loss map of a frame with the place of the touch; see `AbstractView.picture`."""
        values = frame.values
        if isinstance(values, str) or values.shape != self._silence.shape:
            kind = "text" if isinstance(values, str) else f"of {len(values)} numbers"
            reason = f"The frame is {kind}, not {len(self._silence)} intensities."
            return Picture(None, status=FrameStatus.REFUSED, reason=reason)
        try:
            intensities = self._intensities(values - self._silence, frame.second)
            found = locate(intensities, self.calibration, method=self.method, gain_drift=0.0, compiled=False)
        except ValueError as error:
            return Picture(None, status=FrameStatus.REFUSED, reason=str(error))
        status = found.status[0]
        if status == LocationStatus.UNUSABLE:
            return Picture(None, status=FrameStatus.REFUSED, reason="Fewer than three microphones can be used.")
        if status == LocationStatus.NO_TOUCH:
            return Picture(None, status=FrameStatus.UNCHANGED)
        loss = np.asarray(self._localiser.maps(intensities.power, found.used))[0, ::-1]
        if self.method == _LIKELIHOOD:
            loss = np.sqrt(2 * (loss - np.nanmin(loss)))
        reason = "" if status == LocationStatus.TOUCH else f"{status}: see the statuses of jeit locate.".capitalize()
        return Picture(loss.astype(np.float32), self._markers(found), reason=reason)

    def set_reference(self, frames: Float[np.ndarray, "N M"]) -> None:
        """Take the mean of frames (N, M) without a touch as silence, which is subtracted from later frames.

        Raises `ValueError` for another number of microphones, and if one that is calibrated has no reading.
        """
        mean = mean_frame(frames)
        if mean.shape != self._silence.shape or not np.isfinite(mean[self.calibration.usable]).all():
            raise ValueError(f"reference: give intensities of all {len(self._silence)} microphones.")
        self._silence = np.where(np.isfinite(mean), mean, 0.0)

    def _intensities(self, power: Float[np.ndarray, " M"], second: float) -> Intensities:
        usable = np.isfinite(power)[None]
        return Intensities(
            [second],
            power[None],
            floor=self.floor,
            freedom=self.freedom,
            usable=usable,
            faults=[""] * len(power),
            name="live",
        )

    def _markers(self, found) -> tuple[Marker, ...]:
        """Markers of the touch, and of the second one where there are two."""
        project = self._localiser.microphone_array.surface.project
        deviation = float(np.sqrt(np.trace(found.covariance[0]) / 2))
        places = [(found.position[0], _RADIUS * deviation), (found.second[0], float("nan"))]
        return tuple(
            Marker(*np.asarray(project(place[:, None]))[:, 0].tolist(), radius=radius)
            for place, radius in places
            if np.isfinite(place).all()
        )
