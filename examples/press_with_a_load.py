"""A load in newtons on a skin: indenter, pressure, conductivity and a frame over time; see `press_with_a_load.png`.
Takes 6 s and 0.5 GB on two cores."""

import jax
import matplotlib.pyplot as plt
import numpy as np

from jeit.electrodes import BoundaryElectrodes
from jeit.forward import ForwardModel
from jeit.layout import ring
from jeit.mesh import Disk
from jeit.protocol import adjacent
from jeit.touch import BarIndenter, JoinedIndenters, MovingPress, PlacedIndenter, PressedSkin, ball_indenter, material


def main() -> float:
    electrodes = BoundaryElectrodes(ring(0.05, 16), width=0.008, contact_impedance=300.0)
    model = ForwardModel(Disk(0.05).mesh(num_points=3000), electrodes, adjacent(16))
    skin = PressedSkin(jax.random.key(0), model, material("velostat"))
    tool = JoinedIndenters(
        PlacedIndenter(ball_indenter(0.016), (0.012, 0.0)), PlacedIndenter(BarIndenter(0.016, 0.005), (-0.01, 0.0), 0.6)
    )

    # Press for four seconds, hold and release; sample 20 times a second.
    seconds = np.arange(0, 12, 0.05)
    load = np.interp(seconds, [0, 1, 5, 7, 8], [0, 0, 20, 20, 0])
    position, angle = (0.008, 0.01), 0.4
    press = MovingPress(tool, load, position, angle)
    frames = skin.record(jax.random.key(1), press, seconds)
    touched = skin.touched_in_time(press, seconds)

    figure, (shape, under, changed, read) = plt.subplots(1, 4, figsize=(15, 3.6), layout="constrained")
    # Show all three in the coordinates of the skin; the indenter's own frame is translated and rotated.
    x, y = np.meshgrid(np.linspace(-0.02, 0.036, 281), np.linspace(-0.018, 0.038, 281))
    cos, sin = np.cos(angle), np.sin(angle)
    places = (np.stack([x, y], axis=-1) - position) @ np.array([[cos, -sin], [sin, cos]])
    pressure = skin.material.support.pressure(tool, load.max()).at(places)
    extent = (-20, 36, -18, 38)
    drawn = shape.imshow(1e3 * tool.gap(places), origin="lower", extent=extent, cmap="viridis_r")
    figure.colorbar(drawn, ax=shape, label="mm above its lowest point")
    drawn = under.imshow(1e-3 * pressure, origin="lower", extent=extent, cmap="magma")
    figure.colorbar(drawn, ax=under, label="kPa")
    held = int(np.searchsorted(seconds, 7.0))
    change = np.zeros(model.mesh.num_cells)
    np.add.at(change, np.asarray(touched.cells)[held], np.asarray(touched.change)[held])
    drawn = changed.tripcolor(*1e3 * np.asarray(model.mesh.points).T, np.asarray(model.mesh.cells), 100 * change)
    figure.colorbar(drawn, ax=changed, label="% more conductivity")
    changed.set(aspect="equal", xlim=extent[:2], ylim=extent[2:])
    most = np.argsort(-np.abs(frames[held] - skin.rest()))[:3]
    for channel in most:
        read.plot(seconds, 1e3 * (frames - skin.rest())[:, channel], linewidth=1, label=f"channel {channel}")
    read.legend(frameon=False, loc=(0.21, 0.06), fontsize=8)
    above = read.twinx()
    above.plot(seconds, load, "k--", linewidth=1)
    above.set_ylabel("load, N (dashed)")
    read.set(xlabel="s", ylabel="change of three voltages, mV", title="three channels in time")
    for ax, title in ((shape, "indenter"), (under, "pressure"), (changed, "conductivity")):
        ax.set(title=f"{title}, on the skin", xlabel="mm")
    figure.savefig("press_with_a_load.png")

    # This is as exact as solving the model again.
    anew = model.voltages(skin.conductivity * (1 + change)) - model.voltages(skin.conductivity)
    found = skin.voltages_under(touched)[held] - np.asarray(model.voltages(skin.conductivity))
    return float(np.abs(found - anew).max() / np.abs(anew).max())


if __name__ == "__main__":
    error = main()
    print(f"low-rank change against the model solved anew: {error:.0e}")
    assert error < 1e-8
