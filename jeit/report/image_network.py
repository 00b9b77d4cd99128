"""What is left of learning to image, and of the frames that a network imaged, in folders."""

import csv
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from jeit.report.describe import plain, version_of
from jeit.report.folder import results, results_folder, write_json
from jeit.simulate.contact.indent_sets import pixel_places
from jeit.touch.networks import ImageNetwork, LearntImages
from jeit.touch.networks.places import centroids_of

LEARNT_FILES = ("network.jeit", "report.json", "learning.png")
DEPTH_FILES = ("frames.csv", "depth.npz", "depth.png", "report.json")
_PACKAGES = ("jeit", "jax", "equinox", "optax", "numpy")
# Maps that are drawn, at most.
_DRAWN = 6


def write_learnt_images(learnt: LearntImages, folder: str | Path) -> None:
    """Write `report.json` and the picture `learning.png`, beside the network that `learn_images` wrote.

    Raises `ValueError` for what cannot be a folder.
    """
    with results(folder, LEARNT_FILES) as made:
        write_json(report_learnt_images(learnt), made / "report.json")
        draw_learnt_images(learnt).savefig(made / "learning.png", dpi=130)


def report_learnt_images(learnt: LearntImages) -> dict[str, Any]:
    """How well a network learnt to image, as plain numbers, strings, lists and dictionaries."""
    network = learnt.network
    trainings = {
        name: {
            "ended": one.reason,
            "batches": one.course.steps[-1],
            "best_batches": one.course.steps[one.course.best],
            "best_loss_held_out": one.course.validation[one.course.best],
            "loss_held_out": one.course.validation,
            "loss": one.course.training,
        }
        for name, one in learnt.courses.items()
    }
    return plain(
        {
            "design": network.design,
            "made_for": network.made_for,
            "map": {"shape": network.shape, "extent_m": network.extent, "thickness_m": network.thickness},
            "relative_noise": network.noise,
            "share_of_squared_depth_explained": learnt.standing.explained,
            "error_of_a_ball_m": learnt.standing.place,
            "depth_of_a_ball_told": learnt.standing.deepest,
            "trainings": trainings,
            "seconds": learnt.seconds,
            "versions": {package: version_of(package) for package in _PACKAGES},
        }
    )


def draw_learnt_images(learnt: LearntImages):
    """Losses, and maps of touches that nothing was learnt from, right above and told below; a matplotlib `Figure` that
    needs no display."""
    from matplotlib.figure import Figure

    from jeit.plot import plot_depth_map, plot_losses

    right, told = learnt.standing.right, learnt.standing.told
    figure = Figure(figsize=(3 + 2.6 * (len(right) + 1), 5.4), layout="constrained")
    parts = figure.subfigures(1, 2, width_ratios=(4.4, 2.6 * max(len(right), 1)), squeeze=False)
    losses, maps = parts[0]
    plot_losses(learnt.courses, ax=losses.subplots())
    panels = maps.subplots(2, len(right), squeeze=False)
    thickness = learnt.network.thickness
    most = thickness * float(right.max())
    for row, (name, some) in zip(panels, (("right", right), ("told", told)), strict=True):
        for ax, one in zip(row, some, strict=True):
            plot_depth_map(thickness * one, learnt.network.extent, most=most, colour_bar=ax is row[-1], ax=ax)
        row[0].set_title(name)
    return figure


def write_depths(
    depth: Float[np.ndarray, "n rows columns"],
    network: ImageNetwork,
    folder: str | Path,
    *,
    name: str,
    numbers: Sequence[int] | None = None,
) -> dict[str, np.ndarray]:
    """Write what a network told of the frames `name`: `frames.csv`, with a line for each, by their `numbers`, from 0 on
    unless given: `x_m`, `y_m`, the middle of what is deepest, and `depth_m`, how deep; `depth.npz` with all maps;
    `depth.png`; `report.json`.

    Maps of frames that were refused are NaN; where nothing is deeper than noise makes it, there is no middle. Returns
    the columns. Raises `ValueError` for what cannot be a folder, and where no frame was imaged.
    """
    where = results_folder(folder, DEPTH_FILES)
    if not np.isfinite(depth).any():
        raise ValueError(f"depth: none of {len(depth)} frames was imaged; there is nothing to write.")
    places = pixel_places(network.extent, network.shape)
    imaged = np.isfinite(depth.reshape(len(depth), -1)).all(axis=1)
    number = np.arange(len(depth)) if numbers is None else np.asarray(numbers)
    middles = centroids_of(np.nan_to_num(depth), places)
    deepest = depth.reshape(len(depth), -1).max(axis=1)
    middles[~(deepest > network.floor)] = np.nan
    columns = {"x_m": middles[:, 0], "y_m": middles[:, 1], "depth_m": deepest}
    with open(where / "frames.csv", "w", newline="", encoding="utf-8") as file:
        table = csv.writer(file)
        table.writerow(["frame", *columns])
        for own, row in zip(number, zip(*columns.values(), strict=True), strict=True):
            table.writerow([own, *(f"{value:.6g}" if np.isfinite(value) else "" for value in row)])
    np.savez_compressed(where / "depth.npz", depth=depth, extent=np.array(network.extent))
    _draw_depths(depth, np.flatnonzero(imaged), network, number).savefig(where / "depth.png", dpi=130)
    report = {
        "frames": name,
        "number": len(depth),
        "refused": number[~imaged],
        "design": network.design,
        "map": {"shape": network.shape, "extent_m": network.extent},
        "deepest_m": deepest[imaged].max(),
        "depth_by_noise_alone_m": network.floor,
        "units": {"length": "m"},
        "versions": {package: version_of(package) for package in _PACKAGES},
    }
    write_json(plain(report), where / "report.json")
    return columns


def _draw_depths(
    depth: Float[np.ndarray, "n rows columns"],
    imaged: Int[np.ndarray, " k"],
    network: ImageNetwork,
    numbers: Int[np.ndarray, " n"],
):
    from matplotlib.figure import Figure

    from jeit.plot import plot_depth_map

    chosen = imaged[np.unique(np.linspace(0, len(imaged) - 1, _DRAWN).round().astype(int))]
    figure = Figure(figsize=(4.2 * len(chosen), 4.2), layout="constrained")
    # What noise alone makes of the untouched skin is not stretched over the colours.
    most = max(float(depth[imaged].max()), 4 * network.floor)
    for ax, number in zip(figure.subplots(1, len(chosen), squeeze=False)[0], chosen, strict=True):
        last = number == chosen[-1]
        plot_depth_map(
            depth[number], network.extent, most=most, colour_bar=last, title=f"frame {numbers[number]}", ax=ax
        )
    return figure
