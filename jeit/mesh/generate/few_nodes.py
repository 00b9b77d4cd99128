"""Fewer nodes than a mesh needs: said of the number that was asked for, of a sheet or of the solid above it."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager

# Steps in which a number of nodes that will do is looked for, and the largest.
_STEP, _MOST = 1.1, 2e6


class TooFewNodes(ValueError):
    """Raised for a plane mesh of `asked` nodes that takes `least` about. `solid`: what is said, after "num_points: ",
    where the plane mesh is that of a solid, with {asked} and {least} for the numbers of that."""

    def __init__(self, message: str, least: int, solid: str):
        super().__init__(message)
        self.least, self.solid = least, solid


@contextmanager
def nodes_of_solid(asked: int | None, in_plane: Callable[[int], int]) -> Iterator[None]:
    """A `ValueError` about the nodes of a plane mesh, raised within, speaks of those `asked` of the solid on it;
    `in_plane`: how many of them its plane mesh has."""
    try:
        yield
    except TooFewNodes as error:
        if asked is None:
            raise
        number = float(asked)
        while in_plane(round(number)) < error.least and number < _MOST:
            number *= _STEP
        least = float(f"{number:.2g}")
        raise ValueError(f"num_points: {error.solid.format(asked=asked, least=f'{least:.0f}')}") from None
