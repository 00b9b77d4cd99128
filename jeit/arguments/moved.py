"""Names of version 0.1 that are elsewhere now, or have another name: what to write instead.

Every room that names have left calls `tell_old_names`. Whoever asks for one, be it by `from jeit import Mesh` or by
`jeit.Mesh`, is told where it is.
"""

from __future__ import annotations

import sys
from typing import NoReturn

# Of every room: where names have moved to, as they are.
_MOVED = {
    "jeit": {
        "jeit.data": "Measurement",
        "jeit.image": "Raster",
        "jeit.imaging": "ImagingSettings",
        "jeit.mesh": "Mesh Polygon Rectangle",
    },
    "jeit.acoustic": {
        "jeit.acoustic.calibration.calibrate": "CalibrationFit",
        "jeit.acoustic.decay": "AbstractDecay AttenuatedInverseSquare Exponential InverseSquare",
        "jeit.acoustic.localisation.locations": "Locations",
        "jeit.acoustic.localisation.overlay": "brightness overlay",
        "jeit.acoustic.localisation.two_sources": "TwoSources locate_two",
        "jeit.acoustic.noise": "IntensityNoise",
        "jeit.acoustic.signal.intensity": "noise_floor",
        "jeit.acoustic.surface": "make_surface",
        "jeit.acoustic.tracking": "Touch Track",
    },
    "jeit.data": {
        "jeit.data.description": "Description",
        "jeit.data.imageable": "FrameQuality assess check_same_setup",
        "jeit.data.quality": "NoiseEstimate channel_reciprocity_error expected_signs",
        "jeit.data.registry": "FORMATS",
    },
    "jeit.design": {
        "jeit.design.measurements.selection": "Selection farthest_pairs information nearest_pairs random_selections",
        "jeit.design.optimisation.constraints": "Constraints",
        "jeit.design.optimisation.objective": "balanced",
        "jeit.design.optimisation.optimise": "Optimisation",
        "jeit.design.scores": "Score Scores",
        "jeit.design.sensitivity": "SensitivityMap",
        "jeit.design.skin.indentation": "AbstractIndentation",
        "jeit.design.skin.sheet_touches": "SheetTouches sheet_touches",
        "jeit.design.skin.touch_grid": "TouchGrid",
        "jeit.design.skin.voltage_changes": "touch_changes",
        "jeit.design.study": "Study study_progress",
        "jeit.design.taxels": "Taxels",
        "jeit.report": "write_study_report",
    },
    "jeit.design.study": {"jeit.report": "write_study_report"},
    "jeit.electrodes": {
        "jeit.electrodes.electrodes": "Contact",
        "jeit.electrodes.precomputed": "IntegratedElectrodes",
        "jeit.layout": "BUILT_IN Layout grid named_layout perimeter quasi_uniform read_layout ring ring_and_centre "
        "write_layout",
    },
    "jeit.forward": {"jeit.forward.system": "System", "jeit.forward.transfer": "electrode_fields"},
    "jeit.image": {"jeit.image.merit": "FiguresOfMerit", "jeit.image.score": "challenge_score"},
    "jeit.imaging": {"jeit.inverse.prior.defaults": "PRIORS"},
    "jeit.inverse": {
        "jeit.inverse.calibration": "Calibration",
        "jeit.inverse.hyperparameter.choice": "Choice",
        "jeit.inverse.linear.one_step": "LinearReconstruction",
        "jeit.inverse.channel_weights": "repeated_noise",
        "jeit.inverse.nonlinear": "Background Bounded ContactImpedance ElectrodePosition Linear Log Scale",
        "jeit.inverse.nonlinear.links": "AbstractLink",
        "jeit.inverse.nonlinear.problem": "Inversion",
        "jeit.inverse.nonlinear.reconstruct": "Reconstruction",
        "jeit.inverse.nonlinear.unknowns": "AbstractUnknown",
        "jeit.inverse.prior.bases": "Regions pixels",
        "jeit.inverse.prior.priors": "AbstractPrior",
        "jeit.inverse.streaming.stream": "FrameImage",
        "jeit.inverse.uncertainty": "Posterior",
    },
    "jeit.mesh": {
        "jeit.mesh.cell_quality": "Quality",
        "jeit.mesh.geometry": "boundary_loops facet_measures interior_facets",
    },
    "jeit.plot": {
        "jeit.plot.design.taxels": "plot_similarity",
        "jeit.plot.imaging.electrodes": "draw_electrodes",
        "jeit.plot.imaging.image": "plot_raster",
        "jeit.plot.imaging.inclusions": "draw_inclusions",
        "jeit.plot.imaging.labels": "draw_labels",
        "jeit.plot.imaging.sensitivity": "plot_sensitivity",
        "jeit.plot.imaging.voltages": "plot_voltages",
    },
    "jeit.protocol": {"jeit.protocol.reciprocity": "transfer_between_drives"},
    "jeit.simulate": {
        "jeit.simulate.acoustic.calibration_taps": "CalibrationTaps",
        "jeit.simulate.acoustic.sound": "SimulatedSound superpose",
        "jeit.simulate.round_skin": "pressed_conductivity",
    },
}
# What has another name now, or became part of something else.
_RENAMED = {
    "jeit.choosing": "jeit.imaging",
    "jeit.preparation": "jeit.imaging",
    "jeit.track_report": "jeit.report",
    "jeit.acoustic.Changes": "jeit.acoustic.localisation.setup_changes.SetupChanges",
    "jeit.acoustic.Estimate": "jeit.acoustic.localisation.localiser.SourceEstimate",
    "jeit.acoustic.Listeners": "jeit.acoustic.MicrophoneArray",
    "jeit.acoustic.faded": "jeit.acoustic.localisation.overlay.fade",
    "jeit.acoustic.find_changes": "jeit.acoustic.localisation.setup_changes.find_setup_changes",
    "jeit.acoustic.measure": "jeit.acoustic.localisation.calibrated_intensities.calibrated_intensities",
    "jeit.acoustic.prepare": "jeit.acoustic.localisation.locate.microphones_in_use",
    "jeit.data.simulated": "jeit.simulate",
    "jeit.data.sounding_skin": "jeit.simulate.acoustic",
    "jeit.data.touches": "jeit.simulate.acoustic",
    "jeit.design.Felt": "jeit.design.response.SkinResponse",
    "jeit.design.Presses": "jeit.design.skin.touched_cells.TouchedCells",
    "jeit.design.TouchedSkin": "jeit.design.Skin",
    "jeit.design.feel": "jeit.design.skin_response(Skin.create(layout), grid, key=…)",
    "jeit.design.press": "jeit.design.skin.touched_cells.touched_cells",
    "jeit.electrodes.contact_impedance": "electrodes.contact_impedance, a property of theirs",
    "jeit.electrodes.with_contact_impedance": "electrodes.with_contact_impedance(z), a method of theirs",
    "jeit.imaging.DEFAULT_HYPERPARAMETERS": "jeit.inverse.hyperparameter.defaults",
    "jeit.imaging.ITERATIVE_METHODS": "jeit.imaging.METHODS",
    "jeit.imaging.LINEAR_METHODS": "jeit.imaging.METHODS",
    "jeit.mesh.domain": "jeit.mesh.outline",
    "jeit.mesh.facet_centroids": "mesh.points[mesh.facets].mean(axis=1)",
    "jeit.mesh.interior": "jeit.mesh.geometry",
    "jeit.report.draw": "jeit.report.draw_image",
    "jeit.report.report": "jeit.report.report_image",
    "jeit.report.write": "jeit.report.write_image",
}
MOVED = _RENAMED | {
    f"{room}.{name}": f"{home}.{name}"
    for room, homes in _MOVED.items()
    for home, names in homes.items()
    for name in names.split()
}
"""What to write in place of each old name, the room that it was in before it."""


def tell_old_names(room: str) -> None:
    """Give a room a `__getattr__` that raises what `missing` says.

    It is set from here and not written in the room, where type checkers would take every name for one that is there.
    """

    def find(name: str) -> NoReturn:
        raise missing(room, name)

    vars(sys.modules[room])["__getattr__"] = find


def missing(room: str, name: str) -> Exception:
    """The error for a name that a room does not have: of an old one an `ImportError`, which `from room import name`
    shows where it would swallow the text of an `AttributeError`."""
    now = MOVED.get(f"{room}.{name}")
    if now is None:
        return AttributeError(f"module '{room}' has no attribute '{name}'", name=name, obj=sys.modules[room])
    return ImportError(f"'{room}.{name}' of jeit 0.1 is now {now}; see CHANGELOG.md.", name=room)
