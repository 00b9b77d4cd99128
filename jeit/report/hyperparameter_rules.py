"""Reports that compare the rules for the hyperparameter, and reports of measured files."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from jeit.arguments import counted, percent
from jeit.data import Measurement, estimate_noise, impossible_signs, reciprocity_error
from jeit.data.frame_checks import MAX_IMPOSSIBLE_SIGN_SHARE, MAX_RECIPROCITY_ERROR
from jeit.data.quality import rounding_deviation
from jeit.forward import ForwardModel
from jeit.imaging import imaging_mesh
from jeit.imaging.hyperparameter_rules import ComparedRules, RuleOutcome
from jeit.imaging.wiring import MAX_WIRING_MISFIT, find_wiring
from jeit.inverse import detectable_diameters, relative_noise
from jeit.mesh import Mesh
from jeit.report.folder import (
    describe_detectable,
    describe_domain,
    describe_electrodes,
    describe_measurement,
    results,
    to_plain_values,
    write_json,
)

# Approximate number of nodes of the mesh on which wirings are compared and detectable diameters are computed.
_NUM_MESH_NODES = 1000
# Standard deviation of the noise relative to the largest voltage below which voltages are taken for computed ones.
_MIN_RELATIVE_NOISE = 1e-10


def report_measurement(measurement: Measurement) -> dict[str, Any]:
    """Report of a measurement, as printed by `jeit info`: frames, body, electrodes, protocol and noise, in SI units.
    Unknown values are None.

    **Arguments:**

    - `measurement`: the frames.

    **Example:**

    ```python
    report_measurement(pressed)
    ```
    """
    protocol, impossible_sign_shares, model = (
        measurement.protocol,
        impossible_signs(measurement),
        _model_from_description(measurement),
    )
    noise = _report_noise(measurement)
    report = {
        **describe_measurement(measurement),
        "frames": measurement.num_frames,
        "frame_names": list(measurement.frame_names),
        "frame_rate": measurement.frame_rate,
        "voltages": int(np.asarray(measurement.mask).size),
        "protocol": protocol.name,
        "drives": protocol.num_drives,
        "largest_current": float(np.abs(np.asarray(protocol.drive)).max()),
        "largest_voltage": float(np.abs(np.asarray(measurement.filled())).max()),
        "body": describe_domain(measurement.domain),
        "electrodes": {**describe_electrodes(measurement.electrodes), "number": protocol.num_electrodes},
        "reciprocity_error": reciprocity_error(measurement),
        "noise": noise,
        "smallest_detectable_body": _report_detectable_diameters(model, measurement, noise, impossible_sign_shares),
        "impossible_signs": None if impossible_sign_shares is None else float(impossible_sign_shares.max()),
        "wiring": model and _describe_wiring(model, measurement),
    }
    return to_plain_values(report)


def _report_noise(measurement: Measurement) -> dict[str, Any] | None:
    """Report the standard deviation of the noise of the voltages, and the method by which it was estimated. If the
    rounding error of the first frame is larger, it is reported instead, because an estimate from reciprocal voltages,
    which are rounded in the same way, does not include it."""
    noise = estimate_noise(measurement)
    voltages, mask = np.asarray(measurement.voltages)[0], np.asarray(measurement.mask)[0]
    rounding_error = float(np.median(rounding_deviation(voltages, mask)[mask])) if mask.any() else 0.0
    if rounding_error > (0 if noise is None else noise.standard_deviation):
        return {"standard_deviation": rounding_error, "method": "rounding"}
    return None if noise is None else {"standard_deviation": noise.standard_deviation, "method": noise.method}


def _model_from_description(measurement: Measurement) -> ForwardModel | None:
    """Create the forward model of the body that the measurement describes; return None if the body or the positions of
    the electrodes are not known."""
    domain, electrodes = measurement.domain, measurement.electrodes
    if domain is None or electrodes is None:
        return None
    mesh = imaging_mesh(domain, electrodes, None, usual=_NUM_MESH_NODES)
    return ForwardModel(mesh, electrodes, measurement.protocol)


def _reference_frame(measurement: Measurement) -> Measurement:
    """Return the frame named "reference", or all frames if no frame has this name."""
    return measurement.split_reference()[1] if "reference" in measurement.frame_names else measurement


def _report_detectable_diameters(
    model: ForwardModel | None,
    measurement: Measurement,
    noise: dict[str, Any] | None,
    impossible_sign_shares: Float[np.ndarray, " F"] | None,
) -> dict[str, Any]:
    """Report the diameters of the smallest insulating bodies that can be detected in the difference of two frames of
    the file, or the reason why they are not known. The `noise` of the voltages is assumed to be larger for larger
    voltages, see `relative_noise`."""
    reference = _reference_frame(measurement)
    has_used_channels = np.asarray(reference.mask).any(axis=1)
    if model is None:
        return {"not_known_because": "the file does not say where electrodes are"}
    if not has_used_channels.any():
        return {"not_known_because": "no voltage can be used"}
    first_frame = int(np.argmax(has_used_channels))
    voltages, usable_channels = np.asarray(reference.voltages)[first_frame], np.asarray(reference.mask)[first_frame]
    if np.iscomplexobj(voltages):
        return {"not_known_because": "it is computed for real voltages only"}
    if noise is None:
        return {"not_known_because": "the noise is not known; two frames of the same state show it"}
    if noise["standard_deviation"] <= _MIN_RELATIVE_NOISE * np.abs(voltages[usable_channels]).max():
        return {"not_known_because": "the voltages have no noise, as computed ones"}
    if impossible_sign_shares is not None and impossible_sign_shares.max() > MAX_IMPOSSIBLE_SIGN_SHARE:
        return {"not_known_because": "too many voltages have a sign that the body described cannot give"}
    # Voltages across contact impedances, which the description does not determine, hardly change the median.
    resistivity = np.median(np.abs(voltages / np.asarray(model.voltages(1.0)))[usable_channels])
    if not (np.isfinite(resistivity) and resistivity > 0):
        return {"not_known_because": "most voltages are zero"}
    channel_noise = np.asarray(relative_noise(voltages, usable_channels))
    channel_noise = np.sqrt(2) * noise["standard_deviation"] * channel_noise / np.median(channel_noise[usable_channels])
    diameters = detectable_diameters(model, 1 / resistivity, channel_noise, usable_channels)
    return describe_detectable(diameters, f"the noise, from {noise['method']}")


def _describe_wiring(model: ForwardModel, measurement: Measurement) -> str:
    """Describe in words the wiring that was estimated from the frame named "reference", or from the first frame if no
    frame has this name."""
    reference = _reference_frame(measurement)
    wiring, reference_reciprocity_error = find_wiring(model, reference), reciprocity_error(reference)
    if (
        reference_reciprocity_error is not None
        and reference_reciprocity_error > MAX_RECIPROCITY_ERROR
        and not wiring.explanation
    ):
        return (
            f"reciprocity broken by {percent(reference_reciprocity_error)}, and nothing that was tried mends it: "
            "channels or drives in another order than described, or nothing but noise"
        )
    if wiring.fault:
        return wiring.fault
    if wiring.described > MAX_WIRING_MISFIT:
        return f"nothing that was tried speaks against the description, but it misses {percent(wiring.described)}"
    return "nothing speaks against the description"


# Maximum number of inclusions marked in one image, so that the marks do not overlap.
_MAX_MARKED_INCLUSIONS = 8


def write_choice(result: ComparedRules, folder: str | Path) -> None:
    """Write a picture of a comparison of rules for λ, `choice.png`, and a report of the comparison, `choice.json`.

    **Arguments:**

    - `result`: the comparison.
    - `folder`: folder of the files, created if needed.

    Raises `ValueError` for a path that cannot be a folder.

    **Example:**

    ```python
    write_choice(compared, "out")
    ```
    """
    with results(folder, ("choice.png", "choice.json")) as temporary_folder:
        draw_choice(result).savefig(temporary_folder / "choice.png", dpi=120)
        write_json(report_choice(result), temporary_folder / "choice.json")


def draw_choice(result: ComparedRules):
    """Draw the image of every rule, above the curves from which each rule chose λ; return a matplotlib `Figure`.

    **Arguments:**

    - `result`: the comparison.

    **Example:**

    ```python
    draw_choice(compared).savefig("choice.png")
    ```
    """
    from matplotlib.figure import Figure

    from jeit.plot import plot_choice

    outcomes = result.outcomes
    figure = Figure(figsize=(max(2.1 * len(outcomes), 8.4), 8.2), layout="constrained")
    images_figure, curves_figure = np.asarray(figure.subfigures(2, 1, height_ratios=(1, 1.6)))
    image_axes = np.atleast_1d(images_figure.subplots(1, len(outcomes)))
    for ax, (name, outcome) in zip(image_axes, outcomes.items(), strict=True):
        _draw_rule_image(ax, name, outcome, result.prepared.mesh)
    rule_choices = {name: outcome.choice for name, outcome in outcomes.items()}
    plot_choice(rule_choices, ax=curves_figure.subplots())
    figure.suptitle(f"{result.prepared.measurement.name}: change of conductivity by every rule, and how each chose λ")
    return figure


def _draw_rule_image(ax, name: str, outcome: RuleOutcome, mesh: Mesh) -> None:
    """Draw the image of one rule with its own colour scale. Inclusions are marked unless there are more than
    `_MAX_MARKED_INCLUSIONS`."""
    from jeit.plot import ColourScale, plot_image
    from jeit.plot.colours import DARK_GREY
    from jeit.plot.imaging.judgement import RULE_COLOURS

    num_inclusions = len(outcome.inclusions)
    marked_inclusions = outcome.inclusions if num_inclusions <= _MAX_MARKED_INCLUSIONS else ()
    plot_image(mesh, outcome.change, inclusions=marked_inclusions, scale=ColourScale(bar=False), ax=ax)
    _draw_colour_bar(ax, float(jnp.abs(outcome.change).max()), "S" if mesh.dimension == 2 else "S/m")
    ax.set_title(
        f"{name}\n{counted(num_inclusions, 'inclusion')}", color=RULE_COLOURS.get(name, DARK_GREY), fontsize=11, pad=0
    )


def _draw_colour_bar(ax, max_value: float, unit: str) -> None:
    """Draw a small colour bar below an image, with labels at its ends and at zero."""
    from jeit.plot.colours import DARK_GREY, LIGHT_GREY, choose_si_prefix

    prefix_factor, unit = choose_si_prefix(max_value, unit)
    colour_limit = prefix_factor * max_value
    mappable = next(artist for artist in (*ax.images, *ax.collections) if artist.get_array() is not None)
    colour_bar = ax.figure.colorbar(mappable, ax=ax, orientation="horizontal", shrink=0.62, aspect=18, pad=0.01)
    colour_bar.set_ticks(
        [-colour_limit, 0, colour_limit], labels=[f"−{colour_limit:.3g}", "0", f"+{colour_limit:.3g} {unit}"]
    )
    colour_bar.outline.set_visible(False)  # pyright: ignore[reportCallIssue]
    colour_bar.ax.tick_params(length=2, color=LIGHT_GREY, labelcolor=DARK_GREY, labelsize=8)


def report_choice(result: ComparedRules) -> dict[str, Any]:
    """Report of a comparison of rules for λ as plain numbers, strings, lists and dictionaries; unknown values are None.

    **Arguments:**

    - `result`: the comparison.

    **Example:**

    ```python
    report_choice(compared)
    ```
    """
    prepared, settings = result.prepared, result.settings
    unit = "S" if prepared.mesh.dimension == 2 else "S/m"
    rule_reports = []
    for name, outcome in result.outcomes.items():
        choice = outcome.choice
        rule_reports.append(
            {
                "rule": name,
                "hyperparameter": choice.hyperparameter,
                "edge_of_grid": choice.edge or None,
                "note": choice.note or None,
                "relative_residual": outcome.residual,
                "noise_figure": outcome.noise_figure,
                "inclusions": [
                    {
                        "sign": inclusion.sign,
                        "kind": inclusion.kind,
                        "centroid": list(inclusion.centroid),
                        "peak": inclusion.peak,
                    }
                    for inclusion in outcome.inclusions
                ],
                "target": choice.target,
                "candidates": choice.candidates,
                "criterion": choice.criterion,
                "residual": choice.residual,
                "penalty": choice.penalty,
            }
        )
    report = {
        "data": describe_measurement(prepared.measurement),
        "reference": describe_measurement(prepared.reference),
        "mesh": {"points": prepared.mesh.num_points, "cells": prepared.mesh.num_cells},
        "prior": settings.prior if isinstance(settings.prior, str) else type(settings.prior).__name__,
        "background": float(prepared.calibration.conductivity),
        "conductivity_unit": unit,
        "centroid_unit": "m",
        "residual_unit": "standard deviations of jeit.inverse.relative_noise",
        "rules": rule_reports,
        "refused": result.refused,
        "doubts": list(prepared.doubts),
    }
    return to_plain_values(report)
