"""Why the contrast and the area of a body are hard to separate, and how reliable their intervals are in tanks that
differ from their description; see `trust_mechanism.png` and `how_far_to_trust.png`. Takes 30 s and 0.4 GB on two
cores."""

import numpy as np
from matplotlib.figure import Figure

from jeit import BoundaryElectrodes, Disk, ForwardModel, adjacent, image_difference, ring
from jeit.data import Measurement
from jeit.electrodes import body_mesh
from jeit.mesh import centroids

RADIUS, BACKGROUND, NOISE = 0.1, 0.02, 0.003  # metres, siemens, relative
PROTOCOL = adjacent(16, current=1e-3)
DESCRIBED = BoundaryElectrodes(ring(RADIUS, 16), width=0.02, contact_impedance=0.005)
BODIES = [(0.5, 2.35e-3), (2.0, 2.25e-3), (2.0, 1.6e-3), (-0.5, 1.17e-3), (-0.5, 0.99e-3)]  # change, area in m²
INK, BLUE, RED = "#26282b", "#3b7fb5", "#c4473a"


def tank(rng) -> ForwardModel:
    """A tank whose electrodes are 1.5° from their described positions and whose contact impedances differ by a factor
    of two."""
    turned = np.arctan2(*np.asarray(DESCRIBED.position).T[::-1]) + np.deg2rad(1.5) * rng.normal(size=16)
    place = RADIUS * np.stack([np.cos(turned), np.sin(turned)], axis=1)
    electrodes = BoundaryElectrodes(place, 0.02, 0.005 * np.exp(0.7 * rng.normal(size=16)))
    return ForwardModel(body_mesh(Disk(RADIUS), electrodes, 5000), electrodes, PROTOCOL)


def voltages(model: ForwardModel, change: float = 0.0, area: float = 1e-3) -> np.ndarray:
    """Voltages of a tank with a round body."""
    away = np.linalg.norm(np.asarray(centroids(model.mesh)) - [0.02, 0.035], axis=1)
    return np.asarray(model.voltages(BACKGROUND * np.where(away < np.sqrt(area / np.pi), 1 + change, 1.0)))


def mechanism() -> Figure:
    """Two bodies of equal strength in the described tank, and the effect of each error of the tank on the same
    voltages."""
    model = ForwardModel(body_mesh(Disk(RADIUS), DESCRIBED, 5000), DESCRIBED, PROTOCOL)
    weak, strong = (0.5, 2.35e-3), (1.0, 2.35e-3 * (0.5 / 2.5) / (1 / 3))
    rest, of_weak, of_strong = voltages(model), voltages(model, *weak), voltages(model, *strong)
    other = tank(np.random.default_rng(0))
    error = (voltages(other, *weak) - voltages(other)) - (of_weak - rest)
    figure = Figure(figsize=(8, 3.6), layout="constrained")
    ax = figure.subplots()
    lines = {
        "the body, +50 % in 2,350 mm²": (np.abs(of_weak - rest), INK),
        "electrodes 1.5° off, contacts a factor of two apart": (np.abs(error), RED),
        "+100 % in 1,410 mm² instead: the same strength": (np.abs(of_strong - of_weak), BLUE),
    }
    for name, (size, colour) in lines.items():
        ax.plot(1e6 * np.sort(size)[::-1], color=colour, linewidth=1.8, label=name)
    ax.axhline(1e6 * NOISE * np.median(np.abs(rest)), color="#8a8d91", linestyle="--", label="noise of 0.3 %")
    ax.set(yscale="log", xlabel="Channel, the largest first", ylabel="Change of the voltage (µV)", ylim=(1e-2, None))
    ax.legend(frameon=False, fontsize=9)
    return figure


def intervals() -> tuple[Figure, int]:
    """Five tanks, each with a body: the 68 % intervals of its change and its area, and how many contain the truth."""
    figure = Figure(figsize=(8, 3.2), layout="constrained")
    change_ax, area_ax = figure.subplots(1, 2)
    held = 0
    for number, (change, area) in enumerate(BODIES):
        rng = np.random.default_rng(number)
        model, frames = tank(rng), []
        for name, value in (("reference", 0.0), ("frame", change)):
            measured = voltages(model, value, area)
            measured = measured * (1 + NOISE * rng.normal(size=len(measured)))
            mask = np.ones(measured.shape, bool)
            frames.append(Measurement(measured, mask, PROTOCOL, electrodes=DESCRIBED, domain=Disk(RADIUS), name=name))
        (one, *_) = image_difference(frames[1], frames[0]).inclusions
        for ax, truth, interval, scale in (
            (change_ax, change, one.contrast_interval, 100),
            (area_ax, area, one.area_interval, 1e6),
        ):
            assert interval is not None
            low, high = (np.nan if end is None else scale * end for end in interval)
            ax.plot([low, high], [number, number], color=BLUE, linewidth=6, solid_capstyle="butt")
            ax.plot(scale * truth, number, "|", color=INK, markersize=16, markeredgewidth=2)
            held += bool(low <= scale * truth <= high)
    change_ax.set(xlabel="Change of conductivity (%)", ylabel="Tank", yticks=range(len(BODIES)))
    area_ax.set(xlabel="Area (mm²)", yticks=range(len(BODIES)), xlim=(0, None))
    figure.suptitle("68 % intervals (blue) and the truth (black)", fontsize=10)
    return figure, held


def main() -> float:
    """Return the fraction of intervals that do not contain the truth."""
    mechanism().savefig("trust_mechanism.png", dpi=110)
    picture, held = intervals()
    picture.savefig("how_far_to_trust.png", dpi=110)
    print(f"{held} of {2 * len(BODIES)} intervals hold the truth")
    return 1 - held / (2 * len(BODIES))


if __name__ == "__main__":
    missed = main()
    assert missed <= 0.6
