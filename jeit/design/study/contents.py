"""Contents of the store of a study's results: names, units and descriptions of the arrays."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np

from jeit.design.study.batch import study_grid
from jeit.design.study.spec import Study

_SCORE_ARRAYS = {
    "minimum": {"minimum": ("V", "least sensitivity")},
    "mean": {"mean": ("V", "mean sensitivity")},
    "uniformity": {"uniformity": ("1", "mean sensitivity over its root mean square")},
    "blind_spot": {"blind_spot": ("1", "share of the area less sensitive than the noise of all channels")},
    "taxels": {
        "taxel_count": ("1", "virtual taxels of some area"),
        "taxel_area_mean": ("cm²", "mean area of the virtual taxels"),
        "taxel_area_std": ("cm²", "standard deviation of the virtual taxels' areas"),
        "taxel_area_max": ("cm²", "largest area of a virtual taxel"),
    },
    "information": {"information": ("nat", "log-determinant of the information on touches (D)")},
    "mean_variance": {"mean_variance": ("1", "mean posterior variance of a touch's amplitude (A)")},
    "largest_variance": {"largest_variance": ("1", "largest posterior variance of a pattern of touches (E)")},
    "localisation_error": {
        "localisation_error_mean": (
            "mm",
            "mean Cramér-Rao bound of a touch's place, infinite where one has none",
        ),
        "localisation_error_max": ("mm", "largest Cramér-Rao bound of a touch's place"),
        "localisation_lost": ("1", "share of the area where a touch's place cannot be estimated"),
    },
}


class Contents(NamedTuple):
    """Description of the contents of a store of results that are computed in chunks.

    **Fields**

    - `kind`: one word for the contents, such as "study"; `made_by`: the command that creates the contents. Messages
      contain `kind` and `made_by`.
    - `fingerprint`: hash of everything that determines the results.
    - `chunks`: for each chunk, the indices of the rows of every array that belong to the chunk.
    - `arrays`: names of the arrays of results; `attributes`: plain values stored with the arrays.
    - `fill`: function that creates all arrays in an empty Zarr group.
    """

    kind: str
    made_by: str
    fingerprint: str
    chunks: Sequence[Sequence[int]]
    arrays: Sequence[str]
    attributes: dict[str, Any]
    fill: Callable[[Any], None]


def study_contents(study: Study) -> Contents:
    """Contents of the store of a study's results. Each row of an array belongs to one point and is stored in a separate
    file."""
    parameters_of_points = [point.coordinates for point in study.points]
    parameter_values = {
        array_name: [array_values[array_name] for array_values in parameters_of_points]
        for array_name in parameters_of_points[0]
    }
    result_arrays = _result_arrays(study)
    axis_names = ("x_mm", "y_mm", "z_mm") if study.surface else ("x_mm", "y_mm")

    def fill_zarr_group(zarr_group: Any) -> None:
        touched_grid = study_grid(study)
        for array_name, array_values in parameter_values.items():
            _write_array(zarr_group, array_name, "point", array_values)
        for axis_index, array_values in enumerate(np.asarray(touched_grid.places).T):
            _write_array(zarr_group, axis_names[axis_index], "place", np.round(1e3 * array_values, 9).tolist())
        num_points, num_places = len(study.points), len(touched_grid.places)
        for array_name, (array_unit, array_description) in result_arrays.items():
            has_place_axis = array_name == "sensitivity"
            zarr_group.create_array(
                array_name,
                shape=(num_points, num_places) if has_place_axis else (num_points,),
                chunks=(1, num_places) if has_place_axis else (1,),
                dtype="float64",
                fill_value=np.nan,
                dimension_names=("point", "place") if has_place_axis else ("point",),
                attributes={"units": array_unit, "long_name": array_description},
            )

    store_attributes = {
        "coordinates": " ".join([*parameter_values, *axis_names]),
        "name": study.name,
        "study": study.text,
    }
    return Contents(
        "study",
        "'jeit study run'",
        study.fingerprint,
        study.chunks,
        [*result_arrays],
        store_attributes,
        fill_zarr_group,
    )


def _result_arrays(study: Study) -> dict[str, tuple[str, str]]:
    """Unit and description of every result of `study`."""
    result_arrays = {"sensitivity": ("V", "sensitivity ‖Δv‖ to a touch")}
    for score_name, score_arrays in _SCORE_ARRAYS.items():
        if score_name in study.scores:
            result_arrays |= score_arrays
    return result_arrays


def _write_array(zarr_group, array_name: str, dimension_name: str, array_values: list) -> None:
    is_text = isinstance(array_values[0], str)
    numpy_array = np.array(array_values, dtype=object if is_text else None)
    zarr_array = zarr_group.create_array(
        array_name,
        shape=numpy_array.shape,
        chunks=numpy_array.shape,
        dtype=str if is_text else numpy_array.dtype,
        dimension_names=(dimension_name,),
    )
    zarr_array[:] = numpy_array
