"""Summarise images of change by a few numbers a frame, from which touches are segmented and described."""

from __future__ import annotations

import equinox as eqx
import numpy as np
from jaxtyping import Float

from jeit.arguments import check_kind, describe, is_number, real_array
from jeit.mesh import Mesh, centroids, check_flat, measures

# With fewer frames the deviation of the next one is not known.
_LEAST_FRAMES = 10
# A touch exceeds the mean of the peaks of untouched frames by so many deviations.
_ABOVE = 5.0


class ChangeCourse(eqx.Module):
    """Summary of T frames, images x_e of change in the unit of the images, elements e.

    **Fields**: `seconds` (T,); `peak` (T,), P = max_e x_e; `least` (T,), min_e x_e; `half_share` (T,), the share of the
    elements with x_e ≥ P / 2; `mean` (T,) of x_e over the elements above the level that a touch exceeds, 0 where none
    is; `area` (T,), m², of those; `centroid` (T, 2), metres, theirs, weighted by area and by the excess, NaN where none
    is.
    """

    seconds: Float[np.ndarray, " T"]
    peak: Float[np.ndarray, " T"]
    least: Float[np.ndarray, " T"]
    half_share: Float[np.ndarray, " T"]
    mean: Float[np.ndarray, " T"]
    area: Float[np.ndarray, " T"]
    centroid: Float[np.ndarray, "T 2"]

    def __len__(self) -> int:
        """Number of frames."""
        return len(self.seconds)

    def of_frames(self, which: slice | np.ndarray) -> "ChangeCourse":
        """Select some of the frames."""
        return ChangeCourse(*(getattr(self, name)[which] for name in _COLUMNS))

    @classmethod
    def joined(cls, courses: "list[ChangeCourse]") -> "ChangeCourse":
        """Concatenate courses; an empty list gives no frames."""
        shapes = {name: np.empty((0, 2) if name == "centroid" else 0) for name in _COLUMNS}
        parts = {name: [shapes[name], *(getattr(one, name) for one in courses)] for name in _COLUMNS}
        return cls(*(np.concatenate(parts[name]) for name in _COLUMNS))


_COLUMNS = ("seconds", "peak", "least", "half_share", "mean", "area", "centroid")


class TouchLevel(eqx.Module):
    """The `level` that the greatest change of an image exceeds where there is a touch, in the unit of the images.

    `centres` (m, 2), metres, and `areas` (m,), m², of the mesh's elements.
    """

    level: float
    centres: Float[np.ndarray, "m 2"]
    areas: Float[np.ndarray, " m"]

    def __init__(self, mesh: Mesh, level: float):
        """Raises `ValueError` for a mesh that is no sheet's, and a level that is not positive."""
        check_kind("mesh", mesh, Mesh, "a Mesh, that of the images")
        check_flat(mesh, "gestures")
        if mesh.dimension != 2:
            raise ValueError("mesh must be of two dimensions, a sheet's.")
        if not (is_number(level) and level > 0):
            raise ValueError(f"level must be positive, in the images' unit; it is {describe(level)}.")
        self.level = float(level)
        self.centres, self.areas = np.asarray(centroids(mesh)), np.asarray(measures(mesh))

    @classmethod
    def of_untouched(cls, mesh: Mesh, images: Float[np.ndarray, "F m"]) -> "TouchLevel":
        """Estimate the level from images (F, m) of an untouched skin, ten at least.

        It is five standard deviations above the mean of max_e x_e; frames with NaN are left out. Frames that span as
        long as readings will last include drift. Raises `ValueError` for fewer frames, images of another mesh, and such
        as are all the same.
        """
        check_kind("mesh", mesh, Mesh, "a Mesh, that of the images")
        images = check_images(images, mesh.num_cells)
        peaks = images[np.isfinite(images).all(axis=1)].max(axis=1, initial=-np.inf)
        if len(peaks) < _LEAST_FRAMES:
            raise ValueError(
                f"images: give {_LEAST_FRAMES} frames of an untouched skin, or more; {len(peaks)} have none."
            )
        if np.ptp(peaks) == 0:
            raise ValueError("images are all the same and show no noise. Give what was read, not copies of a frame.")
        return cls(mesh, float(peaks.mean() + _ABOVE * peaks.std(ddof=1)))

    def course(self, seconds: Float[np.ndarray, " F"], images: Float[np.ndarray, "F m"]) -> ChangeCourse:
        """Summarise images (F, m) at times `seconds` (F,).

        Raises `ValueError` for images of another mesh, values that are not finite, and other numbers of times.
        """
        images = check_images(images, len(self.areas))
        seconds = check_seconds(seconds, len(images))
        if not np.isfinite(images).all():
            raise ValueError("images have NaN or infinite values; leave out those frames, as `find_touches` does.")
        peak = images.max(axis=1, initial=-np.inf)
        above = images > self.level
        number = np.maximum(above.sum(axis=1), 1)
        weight = self.areas * np.where(above, images - self.level, 0.0)
        total = weight.sum(axis=1, keepdims=True)
        centroid = weight @ self.centres / np.where(total > 0, total, np.nan)
        return ChangeCourse(
            seconds=seconds,
            peak=peak,
            least=images.min(axis=1, initial=np.inf),
            half_share=np.mean(images >= peak[:, None] / 2, axis=1),
            mean=np.where(above, images, 0.0).sum(axis=1) / number,
            area=above @ self.areas,
            centroid=centroid,
        )


def check_images(images: Float[np.ndarray, "F m"], number: int) -> Float[np.ndarray, "F m"]:
    """Convert images of a mesh of `number` elements to an array. Raises `ValueError` for others."""
    images = real_array("images", images, f"images of change (F, {number}), a row a frame")
    if images.ndim != 2 or images.shape[1] != number:
        raise ValueError(
            f"images have shape {images.shape}; give (F, {number}), a row a frame, of the mesh's elements."
        )
    return images


def check_seconds(seconds: Float[np.ndarray, " F"], number: int) -> Float[np.ndarray, " F"]:
    """Convert times of `number` frames to an array. Raises `ValueError` for others, for such as fall, and such as are
    not finite."""
    seconds = real_array("seconds", seconds, f"times ({number},) of the frames")
    if seconds.shape != (number,):
        raise ValueError(f"seconds have shape {seconds.shape}; give one for each of the {number} frames.")
    if not np.isfinite(seconds).all() or (np.diff(seconds) < 0).any():
        raise ValueError("seconds must be finite, and must not fall: sort frames by time.")
    return seconds
