"""Views of what was learnt: places and forces on a skin, and depth by a network."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from jeit.data.description import Description
from jeit.imaging.preparation import imaging_mesh
from jeit.inverse.streaming.stream import FrameStatus
from jeit.live.pictures import AbstractView, LiveFrame, Marker, Picture, Scene
from jeit.live.views.conductivity import mean_frame
from jeit.live.views.contacts import Fed
from jeit.live.views.scene import closed_outline, electrode_curves
from jeit.touch import LearntSkin, Touches
from jeit.touch.learnt.presses import NO_TOUCH
from jeit.touch.networks import FrameDepth, ImageNetwork, resting_frame, stream_depths
from jeit.touch.networks.linear_channels import depth_centroids
from jeit.touch.simulate.contact.indent_sets import pixel_places

# Radius that holds 68 % of a round normal distribution of standard deviation 1; nodes of a mesh for drawing alone;
# frames for which a label or key must stay before it is an event; half the side of a skin of unknown size, metres.
_RADIUS, _NODES, _STEADY, _HALF = float(np.sqrt(-2 * np.log(1 - 0.68))), 400, 2, 0.05


class LearntSkinView(AbstractView):
    """Place and force of a touch, with their uncertainty, its label and keys, as `jeit.touch.LearntSkin.predict`
    estimates them.

    Places are markers; labels and keys that change are events. There is no image.

    **Arguments:**

    - `skin`: the learnt skin.
    - `still`: frames (N, M) of the untouched skin, in the unit of those learnt from; needed if these had a reference.
    - `description`: description of the skin, for its outline and electrodes.

    Raises `ValueError` for a skin whose frames are standardised by session, for which all frames of a session are
    needed, and as `jeit.touch.LearntSkin.predict` for the reference.

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
        self._label, self._keys = _Steady(NO_TOUCH), _Steady("")

    def picture(self, frame: LiveFrame) -> Picture:
        """The touch in a frame; see `AbstractView.picture`."""
        try:
            found = self.skin.predict(frame.values, self.reference)
        except (ValueError, TypeError) as error:
            reason = "The frame is text, not numbers." if isinstance(frame.values, str) else str(error)
            return Picture(None, status=FrameStatus.REFUSED, reason=reason)
        if found.unlike[0]:
            return Picture(None, status=FrameStatus.REFUSED, reason="It is unlike any touch that was learnt from.")
        events = [one for one in (self._label(_label(found)), self._keys(_keys(found))) if one]
        markers = () if found.position is None else _marker(found)
        touched = bool(markers) or _label(found) not in (NO_TOUCH, "") or bool(_keys(found)) or _pressed(found)
        return Picture(
            None,
            markers=markers,
            status=FrameStatus.IMAGED if touched else FrameStatus.UNCHANGED,
            events=tuple(events),
        )

    def set_reference(self, frames: Float[np.ndarray, "N M"]) -> None:
        """Take the mean of frames (N, M) as the new reference."""
        reference = mean_frame(frames)
        self.skin.predict(reference, reference)  # raises ValueError for one that is unlike those learnt from
        self.reference = reference


class DepthView(AbstractView):
    """Depth of indentation, in millimetres, as a network estimates it: the maps of `jeit.touch.stream_depths`.

    A marker stands at the centroid of the map, where it is deeper than noise makes it.

    **Arguments:**

    - `network`: the network of the skin, as from `jeit.touch.read_network`.
    - `still`: frames (N, M) of the untouched skin, volts.
    - `title`: title of the page.

    Raises `ValueError` for another number of channels.

    **Example:**

    ```python
    depths = DepthView(network, rest[None])
    print(depths.picture(LiveFrame(0, 0.0, 0.0, rest)).status)
    ```
    """

    def __init__(self, network: ImageNetwork, still: Float[np.ndarray, "N M"], *, title: str = "Depth of indentation"):
        self.network = network
        self._places = pixel_places(network.extent, network.shape)
        self.set_reference(still)
        x_min, x_max, y_min, y_max = network.extent
        corners = np.array([(x_min, y_min), (x_max, y_min), (x_max, y_max), (x_min, y_max), (x_min, y_min)])
        places = 1e-3 * np.asarray(network.made_for["electrodes_mm"], float)
        self.scene = Scene(
            title=title,
            quantity="depth",
            unit="mm",
            diverging=False,
            extent=network.extent,
            outline=[corners],
            electrodes=[place[None, :2] for place in places],
            names=_numbers(len(places)),
            channels=_numbers(network.made_for["channels"]),
            notes=(f"Depths below {1e3 * network.floor:.2g} mm are noise.",),
        )

    def picture(self, frame: LiveFrame) -> Picture:
        """The map of a frame, the row of the largest y first; see `AbstractView.picture`."""
        if isinstance(frame.values, str):
            return Picture(None, status=FrameStatus.REFUSED, reason="The frame is text, not numbers.")
        one = self._follow(frame.values)
        if one.depth is None:
            return Picture(None, status=FrameStatus.REFUSED, reason=one.reason)
        pixels = (1e3 * one.depth[::-1]).astype(np.float32)
        deepest = float(one.depth.max())
        if deepest <= self.network.floor:
            return Picture(pixels, status=FrameStatus.UNCHANGED)
        x, y = depth_centroids(one.depth[None], self._places)[0].tolist()
        return Picture(pixels, (Marker(x, y, f"{1e3 * deepest:.2f} mm"),))

    def set_reference(self, frames: Float[np.ndarray, "N M"]) -> None:
        """Take the mean of frames (N, M) as the new reference."""
        still = np.atleast_2d(np.asarray(frames, float))
        rest = resting_frame(still)
        self.network.changes(rest, rest)  # raises ValueError for another number of channels
        self._follow: Fed[np.ndarray, FrameDepth] = Fed(lambda given: stream_depths(self.network, given, rest))
        self._follow(rest)  # compiles


class _Steady:
    """Text that is reported once it has stayed the same for some frames."""

    def __init__(self, text: str):
        self._shown = self._last = text
        self._count = 0

    def __call__(self, text: str) -> str:
        """The text, if it has just become steady and is another than before; otherwise an empty string."""
        self._count = self._count + 1 if text == self._last else 1
        self._last = text
        if self._count < _STEADY or text == self._shown:
            return ""
        self._shown = text
        return text


def _marker(found: Touches) -> tuple[Marker, ...]:
    """The place of a touch with its force and label; none where there is no place."""
    place, deviation = np.asarray(found.position)[0, :2], np.asarray(found.position_std)[0, :2]
    if not np.isfinite(place).all():
        return ()
    words = [] if _label(found) in (NO_TOUCH, "") else [_label(found)]
    if found.force is not None and np.isfinite(found.force[0]):
        std = "" if found.force_std is None else f" ± {found.force_std[0]:.2g}"
        words.insert(0, f"{found.force[0]:.2g}{std} N")
    x, y = place.tolist()
    return (Marker(x, y, ", ".join(words), _RADIUS * float(np.sqrt(np.mean(deviation**2)))),)


def _pressed(found: Touches) -> bool:
    return found.force is not None and found.force[0] > 0


def _label(found: Touches) -> str:
    if found.label is None:
        return ""
    probability = np.nan if found.probability is None else found.probability[0]
    label = str(found.label[0])
    return label if label == NO_TOUCH or not np.isfinite(probability) else f"{label} {100 * probability:.0f} %"


def _keys(found: Touches) -> str:
    pressed = [] if found.touched is None else (np.flatnonzero(found.touched[0]) + 1).tolist()
    return f"key{'s' if len(pressed) > 1 else ''} {', '.join(map(str, pressed))}" if pressed else ""


def _numbers(count: int) -> list[str]:
    return [str(one) for one in range(1, count + 1)]


def _skin_scene(skin: LearntSkin, description: Description | None) -> Scene:
    """The outline of a learnt skin as described, or else the box around the places that were learnt from."""
    electrodes: Sequence[np.ndarray] = ()
    notes = []
    if description is not None and description.domain is not None and description.electrodes is not None:
        mesh = imaging_mesh(description.domain, description.electrodes, None, usual=_NODES)
        outline = closed_outline(mesh)
        electrodes = electrode_curves(mesh, description.electrodes)
    else:
        low, high = np.full(2, -_HALF), np.full(2, _HALF)
        if "place" in skin.standing:
            places = np.asarray(skin.standing["place"].right)[:, :2]
            low, high = np.nanmin(places, axis=0), np.nanmax(places, axis=0)
            notes.append("The box is around the places that were learnt from; a description says where the edge is.")
        (x_min, y_min), (x_max, y_max) = low, high
        outline = [np.array([(x_min, y_min), (x_max, y_min), (x_max, y_max), (x_min, y_max), (x_min, y_min)])]
    corners = np.concatenate(outline)
    (x_min, y_min), (x_max, y_max) = corners.min(axis=0).tolist(), corners.max(axis=0).tolist()
    return Scene(
        title=f"Learnt skin, {skin.name}",
        quantity="touch",
        unit="",
        diverging=False,
        extent=(x_min, x_max, y_min, y_max),
        outline=outline,
        electrodes=electrodes,
        names=_numbers(len(electrodes)),
        channels=_numbers(len(skin.channels.used)),
        notes=(*notes, "A ring holds the place with a probability of 68 %.", *skin.notes),
    )
