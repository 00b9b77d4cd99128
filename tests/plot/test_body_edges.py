"""Lines that show the form of a body in space: sharp edges, rims of open surfaces, and the outline as it is seen,
against the edges of boxes and prisms that the tests name."""

import numpy as np
import pytest

from jeit.plot.solid.body import visible_edges

# A box of 1 × 2 × 3: corner k has the coordinates of the bits of k, and each side is two triangles, ordered outward.
CORNERS = np.array([[k & 1, k >> 1 & 1, k >> 2 & 1] for k in range(8)]) * [1.0, 2.0, 3.0]
SIDES = [[0, 2, 3, 1], [4, 5, 7, 6], [0, 1, 5, 4], [2, 6, 7, 3], [0, 4, 6, 2], [1, 3, 7, 5]]
BOX = np.array([half for a, b, c, d in SIDES for half in ([a, b, c], [a, c, d])])


def edges_of(points, triangles, toward):
    """The drawn edges, each once."""
    drawn = visible_edges(points, triangles, np.array(toward) / np.linalg.norm(toward))
    found = {tuple(sorted(edge)) for edge in drawn.tolist()}
    assert len(found) == len(drawn)
    return found


def along_axes(points):
    """All pairs of corners of a box that differ in one coordinate."""
    pairs = [(a, b) for a in range(8) for b in range(a + 1, 8)]
    return {(a, b) for a, b in pairs if np.count_nonzero(points[a] != points[b]) == 1}


@pytest.mark.parametrize("toward", [(1, 0, 0), (1, 2, 3), (-1, 1, -0.2)])
def test_a_box_has_its_twelve_edges_and_no_diagonals(toward):
    assert edges_of(CORNERS, BOX, toward) == along_axes(CORNERS)


def test_an_open_box_has_the_edges_of_its_rim():
    """Without the two triangles of its top; and two triangles of one side have their four edges alone."""
    assert edges_of(CORNERS, np.delete(BOX, [2, 3], axis=0), (1, 2, 3)) == along_axes(CORNERS)
    assert edges_of(CORNERS, BOX[:2], (1, 2, 3)) == {(0, 1), (0, 2), (1, 3), (2, 3)}


def prism(number):
    """A prism of many sides, as for a cylinder: corners of the lower and of the upper polygon, and its triangles."""
    angle = 2 * np.pi * (np.arange(number) + 0.5) / number
    ring = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    points = np.concatenate([np.insert(ring, 2, height, axis=1) for height in (0.0, 1.0)])
    after = np.roll(np.arange(number), -1)
    lower = np.stack([np.arange(number), after, number + after], axis=1)
    upper = np.stack([np.arange(number), number + after, number + np.arange(number)], axis=1)
    fan = np.stack([np.zeros(number - 2, int), np.arange(1, number - 1), np.arange(2, number)], axis=1)
    return points, np.concatenate([lower, upper, fan[:, ::-1], number + fan])


@pytest.mark.parametrize("angle", [0.3, 2.0, 4.4])
def test_the_outline_of_a_round_body_is_where_it_turns_away(angle):
    """Sides of 15° meet in edges that are not sharp: only the two in front of which no side faces the viewer are drawn,
    besides both rims. From above, none."""
    points, triangles = prism(24)
    rims = {tuple(sorted((base + k, base + (k + 1) % 24))) for base in (0, 24) for k in range(24)}
    assert edges_of(points, triangles, (0, 0, 1)) == rims
    toward = np.array([np.cos(angle), np.sin(angle), 0.0])
    across = points[:24] @ [-toward[1], toward[0], 0.0]
    ends = {(int(k), int(k) + 24) for k in (across.argmin(), across.argmax())}
    assert edges_of(points, triangles, toward) - rims == ends


def test_sides_that_are_seen_edge_on_have_one_outline():
    """The edge in front of them, also where rounding errors turn them to the viewer or away."""
    points, triangles = prism(24)
    for k in range(24):
        toward = (np.cos(2 * np.pi * k / 24), np.sin(2 * np.pi * k / 24), 0.0)
        ends = {(end, end + 24) for end in ((k + 5) % 24, (k + 18) % 24)}
        assert {edge for edge in edges_of(points, triangles, toward) if edge[1] - edge[0] == 24} == ends
