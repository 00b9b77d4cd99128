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
_LIKELIHOOD_NAME = "likelihood"


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
        method: str = _LIKELIHOOD_NAME,
        floor: Float[np.ndarray, " M"] | None = None,
        freedom: float = np.inf,
    ):
        self.calibration, self.method = calibration, method
        self.floor, self.freedom = floor, freedom
        self._silent_power = np.zeros(calibration.num_microphones)
        microphone_array, _, _ = microphones_in_use(self._to_intensities(self._silent_power, 0.0), calibration)
        lower_corner, upper_corner = (
            np.asarray(box_corner, float) for box_corner in bounding_box(microphone_array.surface)
        )
        pixel_size = (upper_corner - lower_corner).max() / _NUM_PIXELS
        num_columns, num_rows = (
            max(2, round(side_length / pixel_size)) for side_length in (upper_corner - lower_corner).tolist()
        )
        self._localiser = Localiser.create(
            microphone_array, method=method, map_shape=(num_rows, num_columns), compiled=False
        )
        outline_curve = np.asarray(microphone_array.surface.outline.loops()[0])
        microphone_positions = np.asarray(microphone_array.surface.project(microphone_array.microphones.T)).T
        microphone_names = [str(microphone_number) for microphone_number in range(1, len(microphone_positions) + 1)]
        is_likelihood_method = method == _LIKELIHOOD_NAME
        (x_min, y_min), (x_max, y_max) = lower_corner.tolist(), upper_corner.tolist()
        self.scene = Scene(
            title=f"Touches located by {len(microphone_positions)} microphones, {calibration.name}",
            quantity="distance from the most likely place" if is_likelihood_method else "loss",
            unit="σ" if is_likelihood_method else "",
            diverging=False,
            extent=(x_min, x_max, y_min, y_max),
            outline=[np.concatenate([outline_curve, outline_curve[:1]])],
            electrodes=[microphone_position[None] for microphone_position in microphone_positions],
            names=microphone_names,
            channels=microphone_names,
            notes=("A ring holds the place with a probability of 68 %.",),
        )

    def picture(self, frame: LiveFrame) -> Picture:
        """Compute the loss map of a frame with the position of the touch; see `AbstractView.picture`."""
        frame_values = frame.values
        if isinstance(frame_values, str) or frame_values.shape != self._silent_power.shape:
            content_text = "text" if isinstance(frame_values, str) else f"of {len(frame_values)} numbers"
            refusal_reason = f"The frame is {content_text}, not {len(self._silent_power)} intensities."
            return Picture(None, status=FrameStatus.REFUSED, reason=refusal_reason)
        try:
            frame_intensities = self._to_intensities(frame_values - self._silent_power, frame.second)
            touch_locations = locate(
                frame_intensities, self.calibration, method=self.method, gain_drift=0.0, compiled=False
            )
        except ValueError as error:
            return Picture(None, status=FrameStatus.REFUSED, reason=str(error))
        location_status = touch_locations.status[0]
        if location_status == LocationStatus.UNUSABLE:
            return Picture(None, status=FrameStatus.REFUSED, reason="Fewer than three microphones can be used.")
        if location_status == LocationStatus.NO_TOUCH:
            return Picture(None, status=FrameStatus.UNCHANGED)
        loss_map = np.asarray(self._localiser.maps(frame_intensities.power, touch_locations.used))[0, ::-1]
        if self.method == _LIKELIHOOD_NAME:
            loss_map = np.sqrt(2 * (loss_map - np.nanmin(loss_map)))
        refusal_reason = (
            ""
            if location_status == LocationStatus.TOUCH
            else f"{location_status}: see the statuses of jeit locate.".capitalize()
        )
        return Picture(loss_map.astype(np.float32), self._touch_markers(touch_locations), reason=refusal_reason)

    def set_reference(self, frames: Float[np.ndarray, "N M"]) -> None:
        """Take the mean of `frames` (frames, microphones) without a touch as the intensity of silence, which is
        subtracted from later frames.

        Raises `ValueError` if the number of microphones differs from that of the calibration, and if a calibrated
        microphone has no reading.
        """
        mean_intensity = mean_frame(frames)
        if (
            mean_intensity.shape != self._silent_power.shape
            or not np.isfinite(mean_intensity[self.calibration.usable]).all()
        ):
            raise ValueError(f"reference: give intensities of all {len(self._silent_power)} microphones.")
        self._silent_power = np.where(np.isfinite(mean_intensity), mean_intensity, 0.0)

    def _to_intensities(self, received_power: Float[np.ndarray, " M"], frame_time: float) -> Intensities:
        usable_channels = np.isfinite(received_power)[None]
        return Intensities(
            [frame_time],
            received_power[None],
            floor=self.floor,
            freedom=self.freedom,
            usable=usable_channels,
            faults=[""] * len(received_power),
            name="live",
        )

    def _touch_markers(self, touch_locations) -> tuple[Marker, ...]:
        """Markers of the touch, and of the second touch if there are two."""
        project_to_page = self._localiser.microphone_array.surface.project
        position_deviation = float(np.sqrt(np.trace(touch_locations.covariance[0]) / 2))
        positions_and_radii = [
            (touch_locations.position[0], _RADIUS_OF_68_PERCENT * position_deviation),
            (touch_locations.second[0], float("nan")),
        ]
        return tuple(
            Marker(*np.asarray(project_to_page(touch_position[:, None]))[:, 0].tolist(), radius=marker_radius)
            for touch_position, marker_radius in positions_and_radii
            if np.isfinite(touch_position).all()
        )
