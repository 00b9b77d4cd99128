"""Views of learnt models: positions and forces of touches on a skin, and depth of indentation by a network."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from jeit.data.description import Description
from jeit.imaging.calibration import imaging_mesh
from jeit.inverse.streaming.stream import FrameStatus
from jeit.live.pictures import AbstractView, LiveFrame, Marker, Picture, Scene
from jeit.live.views.conductivity import closed_outline, electrode_curves, mean_frame
from jeit.live.views.contacts import StepwiseGenerator
from jeit.touch import LearntSkin, Touches
from jeit.touch.learnt.recorded_presses import NO_TOUCH
from jeit.touch.networks import FrameDepth, ImageNetwork, resting_frame, stream_depths
from jeit.touch.networks.linear_channels import depth_centroids
from jeit.touch.simulate.contact.indent_sets import pixel_places

# Radius that contains 68 % of an isotropic normal distribution of standard deviation 1.
_RADIUS_OF_68_PERCENT = float(np.sqrt(-2 * np.log(1 - 0.68)))
# Number of nodes of a mesh that is only drawn.
_NUM_NODES = 400
# Number of frames for which a label or key must last to be reported as an event.
_MIN_STEADY_FRAMES = 2
# Half the side in metres of a skin of unknown size.
_HALF_SKIN_SIDE = 0.05


class LearntSkinView(AbstractView):
    """View of the position and force of a touch with their uncertainty, and of its label and keys, all estimated by
    `jeit.touch.LearntSkin.predict`.

    Positions are shown as markers. Changes of label and keys are events. There is no image.

    **Arguments:**

    - `skin`: the learnt skin.
    - `still`: frames (frames, channels) of the untouched skin, in the unit of the training data; required if the
      training data had a reference.
    - `description`: description of the skin, from which the outline and the electrodes are drawn.

    Raises `ValueError` for a skin whose frames are standardised by session, which requires all frames of a session, and
    for a reference that `jeit.touch.LearntSkin.predict` refuses.

    **Example:**

    ```python
    places = LearntSkinView(learnt)
    print(places.picture(LiveFrame(0, 0.0, 0.0, presses.frames[0])).markers)
    ```
    """

    def __init__(
        self,
        skin: LearntSkin,
        still: Float[np.ndarray, "N M"] | None = None,
        *,
        description: Description | None = None,
    ):
        if skin.per_session:
            raise ValueError(
                "model: this skin was learnt per session, whose changes are standardised by all frames of it; learn "
                "it without --per-session to use it frame by frame."
            )
        self.skin, self.reference = skin, None
        if skin.mean_reference is not None:
            if still is None:
                raise ValueError("reference is missing: the skin was learnt from frames with one; give --reference.")
            self.set_reference(still)
        self.scene = _skin_scene(skin, description)
        self._steady_label, self._steady_keys = _SteadyText(NO_TOUCH), _SteadyText("")

    def picture(self, frame: LiveFrame) -> Picture:
        """Estimate the touch in a frame; see `AbstractView.picture`."""
        try:
            predicted_touches = self.skin.predict(frame.values, self.reference)
        except (ValueError, TypeError) as error:
            refusal_reason = "The frame is text, not numbers." if isinstance(frame.values, str) else str(error)
            return Picture(None, status=FrameStatus.REFUSED, reason=refusal_reason)
        if predicted_touches.unlike[0]:
            return Picture(None, status=FrameStatus.REFUSED, reason="It is unlike any touch that was learnt from.")
        touch_events = [
            event_sentence
            for event_sentence in (
                self._steady_label(_label_text(predicted_touches)),
                self._steady_keys(_key_text(predicted_touches)),
            )
            if event_sentence
        ]
        position_markers = () if predicted_touches.position is None else _touch_markers(predicted_touches)
        is_touched = (
            bool(position_markers)
            or _label_text(predicted_touches) not in (NO_TOUCH, "")
            or bool(_key_text(predicted_touches))
            or _has_force(predicted_touches)
        )
        return Picture(
            None,
            markers=position_markers,
            status=FrameStatus.IMAGED if is_touched else FrameStatus.UNCHANGED,
            events=tuple(touch_events),
        )

    def set_reference(self, frames: Float[np.ndarray, "N M"]) -> None:
        """Take the mean of `frames` (frames, channels) as the new reference."""
        mean_reference = mean_frame(frames)
        # Raises ValueError if the reference is unlike the training data.
        self.skin.predict(mean_reference, mean_reference)
        self.reference = mean_reference


class DepthView(AbstractView):
    """View of maps of the indentation depth in millimetres, estimated by a network (`jeit.touch.stream_depths`).

    A marker shows the centroid of the map if the maximum depth exceeds the noise.

    **Arguments:**

    - `network`: the network of the skin, as returned by `jeit.touch.read_network`.
    - `still`: frames (frames, channels) of the untouched skin, volts.
    - `title`: title of the page.

    Raises `ValueError` if the number of channels of `still` differs from that of the network.

    **Example:**

    ```python
    depths = DepthView(network, rest[None])
    print(depths.picture(LiveFrame(0, 0.0, 0.0, rest)).status)
    ```
    """

    def __init__(self, network: ImageNetwork, still: Float[np.ndarray, "N M"], *, title: str = "Depth of indentation"):
        self.network = network
        self._pixel_positions = pixel_places(network.extent, network.shape)
        self.set_reference(still)
        x_min, x_max, y_min, y_max = network.extent
        outline_corners = np.array([(x_min, y_min), (x_max, y_min), (x_max, y_max), (x_min, y_max), (x_min, y_min)])
        electrode_positions = 1e-3 * np.asarray(network.made_for["electrodes_mm"], float)
        self.scene = Scene(
            title=title,
            quantity="depth",
            unit="mm",
            diverging=False,
            extent=network.extent,
            outline=[outline_corners],
            electrodes=[electrode_position[None, :2] for electrode_position in electrode_positions],
            names=_numbers_from_one(len(electrode_positions)),
            channels=_numbers_from_one(network.made_for["channels"]),
            notes=(f"Depths below {1e3 * network.floor:.2g} mm are noise.",),
        )

    def picture(self, frame: LiveFrame) -> Picture:
        """Compute the depth map of a frame, with the row of the largest y first; see `AbstractView.picture`."""
        if isinstance(frame.values, str):
            return Picture(None, status=FrameStatus.REFUSED, reason="The frame is text, not numbers.")
        frame_depth = self._estimate_depth(frame.values)
        if frame_depth.depth is None:
            return Picture(None, status=FrameStatus.REFUSED, reason=frame_depth.reason)
        depth_pixels = (1e3 * frame_depth.depth[::-1]).astype(np.float32)
        max_depth = float(frame_depth.depth.max())
        if max_depth <= self.network.floor:
            return Picture(depth_pixels, status=FrameStatus.UNCHANGED)
        x, y = depth_centroids(frame_depth.depth[None], self._pixel_positions)[0].tolist()
        return Picture(depth_pixels, (Marker(x, y, f"{1e3 * max_depth:.2f} mm"),))

    def set_reference(self, frames: Float[np.ndarray, "N M"]) -> None:
        """Take the mean of `frames` (frames, channels) as the new reference."""
        reference_frames = np.atleast_2d(np.asarray(frames, float))
        mean_reference = resting_frame(reference_frames)
        self.network.changes(mean_reference, mean_reference)  # raises ValueError for a different number of channels
        self._estimate_depth: StepwiseGenerator[np.ndarray, FrameDepth] = StepwiseGenerator(
            lambda frame_iterator: stream_depths(self.network, frame_iterator, mean_reference)
        )
        self._estimate_depth(mean_reference)  # compiles the network


class _SteadyText:
    """Filter for a text, such as a label, that reports the text when it has been the same for some frames."""

    def __init__(self, text: str):
        self._reported_text = self._last_text = text
        self._num_equal_texts = 0

    def __call__(self, text: str) -> str:
        """Return the text if it has now been the same for enough frames and differs from the last reported text;
        otherwise an empty string."""
        self._num_equal_texts = self._num_equal_texts + 1 if text == self._last_text else 1
        self._last_text = text
        if self._num_equal_texts < _MIN_STEADY_FRAMES or text == self._reported_text:
            return ""
        self._reported_text = text
        return text


def _touch_markers(predicted_touches: Touches) -> tuple[Marker, ...]:
    """Return the marker of a touch with its force and label; an empty tuple if no position is estimated."""
    touch_position, position_deviation = (
        np.asarray(predicted_touches.position)[0, :2],
        np.asarray(predicted_touches.position_std)[0, :2],
    )
    if not np.isfinite(touch_position).all():
        return ()
    marker_texts = [] if _label_text(predicted_touches) in (NO_TOUCH, "") else [_label_text(predicted_touches)]
    if predicted_touches.force is not None and np.isfinite(predicted_touches.force[0]):
        deviation_text = "" if predicted_touches.force_std is None else f" ± {predicted_touches.force_std[0]:.2g}"
        marker_texts.insert(0, f"{predicted_touches.force[0]:.2g}{deviation_text} N")
    x, y = touch_position.tolist()
    return (
        Marker(x, y, ", ".join(marker_texts), _RADIUS_OF_68_PERCENT * float(np.sqrt(np.mean(position_deviation**2)))),
    )


def _has_force(predicted_touches: Touches) -> bool:
    return predicted_touches.force is not None and predicted_touches.force[0] > 0


def _label_text(predicted_touches: Touches) -> str:
    if predicted_touches.label is None:
        return ""
    label_probability = np.nan if predicted_touches.probability is None else predicted_touches.probability[0]
    touch_label = str(predicted_touches.label[0])
    return (
        touch_label
        if touch_label == NO_TOUCH or not np.isfinite(label_probability)
        else f"{touch_label} {100 * label_probability:.0f} %"
    )


def _key_text(predicted_touches: Touches) -> str:
    key_numbers = (
        [] if predicted_touches.touched is None else (np.flatnonzero(predicted_touches.touched[0]) + 1).tolist()
    )
    return f"key{'s' if len(key_numbers) > 1 else ''} {', '.join(map(str, key_numbers))}" if key_numbers else ""


def _numbers_from_one(num_electrodes: int) -> list[str]:
    return [str(electrode_number) for electrode_number in range(1, num_electrodes + 1)]


def _skin_scene(learnt_skin: LearntSkin, description: Description | None) -> Scene:
    """Create the scene of a learnt skin. The outline is taken from the description, or else is the bounding box of the
    touch positions in the training data."""
    electrodes: Sequence[np.ndarray] = ()
    scene_notes = []
    if description is not None and description.domain is not None and description.electrodes is not None:
        mesh = imaging_mesh(description.domain, description.electrodes, None, usual=_NUM_NODES)
        outline_curves = closed_outline(mesh)
        electrodes = electrode_curves(mesh, description.electrodes)
    else:
        lower_corner, upper_corner = np.full(2, -_HALF_SKIN_SIDE), np.full(2, _HALF_SKIN_SIDE)
        if "place" in learnt_skin.standing:
            electrode_positions = np.asarray(learnt_skin.standing["place"].right)[:, :2]
            lower_corner, upper_corner = np.nanmin(electrode_positions, axis=0), np.nanmax(electrode_positions, axis=0)
            scene_notes.append(
                "The box is around the places that were learnt from; a description says where the edge is."
            )
        (x_min, y_min), (x_max, y_max) = lower_corner, upper_corner
        outline_curves = [np.array([(x_min, y_min), (x_max, y_min), (x_max, y_max), (x_min, y_max), (x_min, y_min)])]
    outline_points = np.concatenate(outline_curves)
    (x_min, y_min), (x_max, y_max) = outline_points.min(axis=0).tolist(), outline_points.max(axis=0).tolist()
    return Scene(
        title=f"Learnt skin, {learnt_skin.name}",
        quantity="touch",
        unit="",
        diverging=False,
        extent=(x_min, x_max, y_min, y_max),
        outline=outline_curves,
        electrodes=electrodes,
        names=_numbers_from_one(len(electrodes)),
        channels=_numbers_from_one(len(learnt_skin.channels.used)),
        notes=(*scene_notes, "A ring holds the place with a probability of 68 %.", *learnt_skin.notes),
    )
