"""Where the microphones of a simulated skin are."""

import numpy as np


def microphone_grid(number: int, *, width: float = 0.2, height: float = 0.2) -> np.ndarray:
    """The centres (number², 2), metres, of number x number equal cells of the skin, row by row from the lower left."""
    if number < 1:
        raise ValueError(f"number: give how many points a row has, at least 1; it is {number}.")
    along = (np.arange(number) + 0.5) / number - 0.5
    y, x = np.meshgrid(along * height, along * width, indexing="ij")
    return np.stack([x.ravel(), y.ravel()], axis=-1)
