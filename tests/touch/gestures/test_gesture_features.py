"""The seven features of a touch, by their definitions on a mesh of four elements, and further features of its time
course.
"""

import numpy as np
import pytest

from jeit.mesh import Mesh, centroids
from jeit.touch.gestures import COURSE_FEATURES, FEATURES, TouchLevel, course_features, find_touches, touch_features

# A square of 2 cm cut along its diagonals: four triangles of 1 cm².
MESH = Mesh.create(
    np.array([[0.0, 0.0], [0.02, 0.0], [0.02, 0.02], [0.0, 0.02], [0.01, 0.01]]),
    np.array([[0, 1, 4], [1, 2, 4], [2, 3, 4], [3, 0, 4]]),
)
LEVEL = TouchLevel(MESH, 1.0)
# A touch of three frames at 0.5 s intervals.
IMAGES = np.array([[0, 0, 0, 0], [2, 0, -1, 0], [6, 4, -2, 2], [0, 0, -3, 3], [0, 0, -9, 0]], float)


def touch():
    (one,) = find_touches(LEVEL, np.arange(5) / 2, IMAGES, gap=0.9)
    return one


def test_the_seven_features():
    found = touch_features([touch()])
    values = dict(zip(found.names, found.values[0], strict=True))
    centres = np.asarray(centroids(MESH))
    assert values["greatest change"] == 6
    assert values["least change"] == -3  # not that of the frame after it
    assert values["share above half"] == 0.5  # 6 and 4, of four
    assert values["mean in contact"] == 4  # 6, 4 and 2
    assert values["duration"] == 1
    assert values["rate of change"] == pytest.approx((8 + 6) / 2)  # 4 and 3 in half a second each
    assert values["displacement"] == pytest.approx(np.linalg.norm(centres[3] - centres[0]))
    assert found.units == tuple(FEATURES.values()) == ("image", "image", "1", "image", "s", "image/s", "m")


def test_a_centroid_is_weighted_by_the_excess_over_the_level():
    centres = np.asarray(centroids(MESH))
    right = (5 * centres[0] + 3 * centres[1] + 1 * centres[3]) / 9
    np.testing.assert_allclose(touch().course.centroid[1], right)
    assert touch().course.area == pytest.approx([1e-4, 3e-4, 1e-4])


def test_features_of_one_frame_are_finite():
    touches = find_touches(LEVEL, np.arange(5) / 50, IMAGES[[0, 2, 0, 0, 0]], least=1)
    found = course_features(touches)
    assert np.isfinite(found.values).all()
    assert found.values[0, list(FEATURES).index("rate of change")] == 0


def test_further_features_of_the_time_course():
    found = course_features([touch()])
    values = dict(zip(found.names, found.values[0], strict=True))
    assert found.names == COURSE_FEATURES
    assert len(found.units) == len(found.names) == found.values.shape[1]
    np.testing.assert_array_equal(found.values[:, :7], touch_features([touch()]).values)
    place = touch().course.centroid
    steps = np.linalg.norm(np.diff(place, axis=0), axis=1)
    assert values["path length"] == pytest.approx(steps.sum())
    assert values["speed"] == pytest.approx(steps.sum() / 1.0)
    assert (values["rise"], values["decay"], values["peaks"]) == (0.5, 0.5, 1)
    assert values["course 1"] == pytest.approx(1 / 3)
    assert values["course 16"] == pytest.approx(0.5)


def test_peaks_are_counted():
    seconds = np.arange(9) / 100
    images = np.zeros((9, 4))
    images[:, 0] = [0, 2, 6, 2, 6, 2, 6, 2, 0]
    (one,) = find_touches(LEVEL, seconds, images)
    found = course_features([one])
    assert found.values[0, found.names.index("peaks")] == 3
