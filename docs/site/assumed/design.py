from pathlib import Path

import jax
import numpy as np

from jeit.design import Bell, Candidates, DesignSpace, Objective, Skin, read_study, skin_response, touch_grid
from jeit.layout import SurfaceLayout, named_layout, spread
from jeit.mesh import Rectangle, tube, unroll
from jeit.protocol import two_terminal

key = jax.random.key(0)
layout = named_layout("grid-4x2", Rectangle(0.1, 0.08))
skin = Skin.create(layout, num_layers=2, cell_size=0.008)  # a layer
touches = touch_grid(skin.outline, 6, 5)

sheet = Skin.create(layout, num_layers=0, num_points=300, protocol=two_terminal(8))
other = sheet.with_layout(named_layout("perimeter-8", Rectangle(0.1, 0.08)))
response = skin_response(sheet, touches, num_taxels=4, key=key)
objective = Objective.create(sheet, touches.places, noise=1e-4)
changes = sheet.voltage_changes(objective.touches.touched, linear=True)  # (30, 28)
candidates = Candidates.from_factor(changes.T, objective.prior.factor, noise=1e-4)

surface = tube(0.03, 0.08, num_points=250)
placed = SurfaceLayout(spread(surface, 8, margin=0.02), 8e-3, surface, contact_impedance=1e-4)
curved = Skin.create(placed, num_layers=0)
curved_objective = Objective.create(curved, touch_grid(curved.outline, 5, 5).places, correlation=0.02)

Path("skin.toml").write_text('[skin]\nmodel = "sheet"\n[electrodes]\nlayout = "grid-4x2"\n')
Path("study.toml").write_text('[electrodes]\nlayouts = ["grid-4x2", "inner-8"]\n[touch]\ncolumns = 6\nrows = 6\n')
study = read_study("study.toml")
