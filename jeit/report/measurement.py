"""Report of a measured file: its content and quality, as plain numbers and words."""

from __future__ import annotations

from typing import Any

import numpy as np

from jeit.arguments import percent
from jeit.data import Measurement, estimate_noise, impossible_signs, reciprocity_error
from jeit.data.imageable import MOST_DIFFERENCE_RECIPROCITY_ERROR
from jeit.forward import ForwardModel
from jeit.imaging import imaging_mesh
from jeit.imaging.wiring import MOST_MISFIT, find_wiring
from jeit.report.folder import describe_domain, describe_electrodes, describe_measurement, plain

# Number of nodes of the mesh on which wirings are compared.
_NODES = 1000


def report_measurement(measurement: Measurement) -> dict[str, Any]:
    """Report that `jeit info` prints: frames, body, electrodes, protocol and noise of a measurement, in SI units; what
    is not known is None."""
    protocol, noise, signs = measurement.protocol, estimate_noise(measurement), impossible_signs(measurement)
    content = {
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
        "noise": None if noise is None else {"standard_deviation": noise.standard_deviation, "method": noise.method},
        "impossible_signs": None if signs is None else float(signs.max()),
        "wiring": _wiring(measurement),
    }
    return plain(content)


def _wiring(measurement: Measurement) -> str | None:
    """Estimated wiring of electrodes and channels, from the reference, or else the first frame; None where the file
    does not say where electrodes are."""
    domain, electrodes = measurement.domain, measurement.electrodes
    if domain is None or electrodes is None:
        return None
    _, reference = measurement.split_reference() if "reference" in measurement.frame_names else (None, measurement)
    model = ForwardModel(imaging_mesh(domain, electrodes, None, usual=_NODES), electrodes, measurement.protocol)
    found, broken = find_wiring(model, reference), reciprocity_error(reference)
    if broken is not None and broken > MOST_DIFFERENCE_RECIPROCITY_ERROR and not found.explanation:
        return (
            f"reciprocity broken by {percent(broken)}, and nothing that was tried mends it: channels or drives in "
            "another order than described, or nothing but noise"
        )
    if found.fault:
        return found.fault
    if found.described > MOST_MISFIT:
        return f"nothing that was tried speaks against the description, but it misses {percent(found.described)}"
    return "nothing speaks against the description"
