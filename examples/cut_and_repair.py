"""A skin is cut, used further and mended, after Park et al. 2022: detection of the events, and touches beside the cut.

See `cut_and_repair.png`. Takes 15 s and 0.5 GB on two cores.
"""

import equinox as eqx
import jax
import matplotlib.pyplot as plt
import numpy as np

from jeit.forward import ForwardModel
from jeit.layout import named_layout
from jeit.mesh import Rectangle
from jeit.protocol import two_terminal
from jeit.touch import (
    CellFinder,
    Cut,
    DamageEvent,
    MovingPress,
    PressedSkin,
    SkinHealth,
    ball_indenter,
    find_contacts,
    material,
    mend_cut,
    plot_health,
    record_damage,
    watch,
)

RATE, CUT_AT, MENDED_AT = 5.0, 30.0, 75.0


def main() -> float:
    # A sheet of 200 × 200 mm with 32 electrodes inside. Each electrode is measured against its five nearest neighbours.
    layout, outline = named_layout("park-inner"), Rectangle(0.2, 0.2, (0.0, 0.0))
    distance = np.linalg.norm(layout.centres[:, None] - layout.centres, axis=-1)
    nearest = np.sort(np.column_stack([np.repeat(np.arange(32), 5), np.argsort(distance)[:, 1:6].ravel()]), axis=1)
    protocol = two_terminal(32, np.unique(nearest, axis=0), current=1e-3)
    electrodes, cut = layout.sheet_discs(1e-4), Cut([(-0.01, 0.012), (0.02, 0.03), (0.034, 0.031)])
    fine = ForwardModel(outline.mesh(num_points=2000, refine=cut.refine(1.5e-3)), electrodes, protocol)
    coarse = ForwardModel(outline.mesh(num_points=900), electrodes, protocol)

    # The simulated skin stands for a real one: intact, then cut, then glued.
    whole = PressedSkin(jax.random.key(0), fine, material("hydrogel"))
    torn = eqx.tree_at(lambda one: one.conductivity, whole, cut.conductivity(fine.mesh, whole.conductivity))
    values, glue = mend_cut(fine.mesh, whole.conductivity, cut, whole.material, 0.95)
    glued = eqx.tree_at(lambda one: (one.conductivity, one.material), whole, (values, glue))

    def simulate(key: int, last: float, events: list[DamageEvent]) -> tuple[np.ndarray, np.ndarray]:
        """Simulate a touch of 1.6 s every six seconds."""
        seconds = np.arange(0, last, 1 / RATE)
        places = np.random.default_rng(key).uniform(-0.08, 0.08, (int(last / 6) + 1, 2))
        load = np.interp(seconds % 6, [2, 2.4, 3.2, 3.6], [0, 5, 5, 0])
        press = MovingPress(ball_indenter(0.02), load, places[(seconds / 6).astype(int)])
        return seconds, record_damage(jax.random.key(key), whole, press, seconds, events)

    seconds, frames = simulate(1, 60.0, [])
    health = SkinHealth.fit(frames, seconds, model=coarse, conductivity=0.01, sign=-1, patience=20.0)
    seconds, frames = simulate(2, 120.0, [DamageEvent(CUT_AT, torn), DamageEvent(MENDED_AT, glued)])
    before = watch(health, frames[seconds < MENDED_AT], seconds[seconds < MENDED_AT])
    after = watch(before, frames[seconds >= MENDED_AT], seconds[seconds >= MENDED_AT])
    for event in after.events:
        description = f"{event.kind}, {1e3 * event.length:.0f} mm ({event.status})"
        print(f"{event.time:6.1f} s, detected at {event.noticed:.1f} s: {description}")

    figure, axes = plt.subplots(1, 4, figsize=(18, 4.6), layout="constrained")
    finder, errors = CellFinder(coarse.mesh, sign=-1), []
    states = ((health, whole, "whole"), (before, torn, "cut: its new reference"), (after, glued, "mended"))
    for ax, (known, skin, state) in zip(axes, states, strict=False):
        place = np.array([-0.05, -0.03])
        touched = skin.touched_in_time(MovingPress(ball_indenter(0.02), np.array([5.0]), place), np.zeros(1))
        conductivity = np.array(np.broadcast_to(skin.conductivity, fine.mesh.num_cells))
        np.multiply.at(conductivity, np.asarray(touched.cells)[0], 1 + np.asarray(touched.change)[0])
        rest, pressed = (np.asarray(skin.model.voltages(one)) for one in (skin.conductivity, conductivity))
        (image,) = known.images((known.reference + skin.gain * (pressed - rest))[None])
        contact = find_contacts(finder, image)[0]
        errors.append(float(np.linalg.norm(contact.centroid - place)))
        plot_health(known, image, title=f"{state}; a touch, {1e3 * errors[-1]:.1f} mm off", ax=ax)
        ax.plot(*cut.path.T, color="black", linewidth=0.8, linestyle=":", zorder=8)
    strongest = np.argsort(-np.abs(before.events[0].change))[:4]
    axes[3].plot(seconds, 1e3 * (frames - frames[0])[:, strongest], linewidth=0.9)
    for event in after.events:
        axes[3].axvline(event.time, color="black", linestyle="--", linewidth=0.8)
        axes[3].annotate(f" {event.kind}", (event.time, axes[3].get_ylim()[1]), va="top", fontsize=9)
    axes[3].set(xlabel="s", ylabel="mV", title="change of four channels; events dashed")
    figure.savefig("cut_and_repair.png")

    path = before.events[0].path
    assert path is not None
    found = Cut(path).along(1e-3)
    apart = np.linalg.norm(cut.along(1e-3)[:, None] - found, axis=-1)
    return max(*errors, 0.5 * float(apart.min(axis=0).mean() + apart.min(axis=1).mean()))


if __name__ == "__main__":
    error = main()
    print(f"the cut, and touches beside it, are at most {1e3 * error:.1f} mm off")
    assert error < 0.015
