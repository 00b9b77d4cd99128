"""Noise of linear images: how far each cell strays while nothing touches, and how cells stray together."""

import equinox as eqx
import numpy as np
from jaxtyping import Float

from jeit.arguments import check_kind, counted
from jeit.inverse.linear.one_step import LinearReconstruction

# Fewer frames do not say how far the next one may stray.
_LEAST_FRAMES = 10
# Of normal noise: the standard deviation over the median of the absolute value.
_NORMAL = 1.4826


class ImageNoise(eqx.Module):
    """Standard deviation of every cell, `deviation` (m,), in the unit of the image; and, where it is known how cells
    stray together, `factor` (r, m), whose product factorᵀ factor is their covariance."""

    deviation: Float[np.ndarray, " m"]
    factor: Float[np.ndarray, "r m"] | None = None

    @classmethod
    def of_frames(cls, reconstruction: LinearReconstruction, frames: Float[np.ndarray, "n M"]) -> "ImageNoise":
        """From repeated frames (n, M) volts of the skin that nobody touches, ten at least.

        What they stray by about their mean is imaged. Frames that span as long as readings will last hold the drift
        too, which frames of one moment do not. Raises `ValueError` for fewer frames, other channels, NaN, and frames
        that are all the same.
        """
        check_kind("reconstruction", reconstruction, LinearReconstruction, "a linear one, such as of one_step(...)")
        frames = np.asarray(frames)
        if frames.ndim != 2 or len(frames) < _LEAST_FRAMES:
            raise ValueError(
                f"frames has shape {frames.shape}; give (n, {reconstruction.num_measurements}) volts of an untouched "
                f"skin, {counted(_LEAST_FRAMES, 'frame')} or more."
            )
        strayed = frames - frames.mean(axis=0)
        if not strayed.any():
            raise ValueError("frames are all the same: they tell no noise. Give what was read, not copies of a frame.")
        return cls._of_factor(np.asarray(reconstruction.image(strayed)) / np.sqrt(len(frames) - 1))

    @classmethod
    def of_channels(cls, reconstruction: LinearReconstruction, deviation) -> "ImageNoise":
        """From the standard deviation of each channel, (M,) or one number, volts; channels independent.

        A difference of two such frames strays √2 as far. Raises `ValueError` for those that are negative, not finite,
        all zero, or of another number of channels.
        """
        check_kind("reconstruction", reconstruction, LinearReconstruction, "a linear one, such as of one_step(...)")
        deviation, number = np.asarray(deviation, float), reconstruction.num_measurements
        if deviation.shape not in ((), (number,)):
            raise ValueError(f"deviation has shape {deviation.shape}; give one number, or ({number},), volts.")
        if not (np.isfinite(deviation).all() and (deviation >= 0).all() and deviation.any()):
            raise ValueError("deviation must be finite, zero or more, and not zero for all channels, in volts.")
        return cls._of_factor(np.broadcast_to(deviation, number)[:, None] * np.asarray(reconstruction.matrix).T)

    @classmethod
    def of_image(cls, image: Float[np.ndarray, " m"]) -> "ImageNoise":
        """From an image (m,) alone, contacts in it or not: 1.48 times the median distance from its median, for all
        cells alike.

        What a contact leaves all over an image, and ringing, count as noise, so that weak contacts beside strong ones
        go unseen; and cells that stray further than most are taken for contacts. Raises `ValueError` for an image
        that is not (m,), finite and real.
        """
        values = np.asarray(image)
        if values.ndim != 1 or values.dtype.kind not in "iuf" or not np.isfinite(values).all():
            raise ValueError("image must be real and finite, one value a cell (m,).")
        spread = _NORMAL * float(np.median(np.abs(values - np.median(values))))
        return cls(np.full(values.shape, spread))

    @classmethod
    def _of_factor(cls, factor: np.ndarray) -> "ImageNoise":
        return cls(np.sqrt((factor**2).sum(axis=0)), factor)

    def distance(self, slope: Float[np.ndarray, "m 2"]) -> float:
        """Root mean square distance that a place moves whose derivative by the image is `slope` (m, 2), metres over the
        image's unit. Where it is not known how cells stray together: the most that it can be."""
        if self.factor is None:
            return float(np.linalg.norm(self.deviation @ np.abs(slope)))
        return float(np.linalg.norm(self.factor @ slope))
