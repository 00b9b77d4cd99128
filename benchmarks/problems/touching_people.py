"""The sheet of Silvera Tawil et al. (2011), and people who touch it, simulated: sets of gestures, imaged and segmented.

The sheet has 320 × 200 mm, 16 electrodes 10 mm from the edge and one at the centre, eyelets of 7 mm, 1.8 mA through
adjacent electrodes, 224 potentials against the centre, 60 frames/s. It is simulated with the complete electrode model
on a mesh of about 2,000 nodes, and imaged by one step with the NOSER prior on a mesh of 1,193 nodes. The differences
between people are in `jeit.touch.simulate.people`, fixed before accuracies were computed.
"""

from __future__ import annotations

import hashlib
from pathlib import Path

import jax
import numpy as np

from jeit import ForwardModel, one_step
from jeit.data import GestureSet
from jeit.data.description import parse_description
from jeit.electrodes import SheetDiscs
from jeit.layout import perimeter
from jeit.mesh import Rectangle
from jeit.protocol import reference_electrode
from jeit.touch.gestures import StreamTouch, TouchLevel, find_touches
from jeit.touch.simulate import PressedSkin, material
from jeit.touch.simulate.people import MANNERS, GestureStream, Person, simulate_gesture_stream, simulate_gestures

SIDES, INSET, EYELET, CURRENT, CONTACT = (0.32, 0.2), 0.01, 0.007, 1.8e-3, 1e-3
NODES, FINE_NODES = 1193, 2000
# Version of stored sets, which must be increased when the simulation changes.
_VERSION = 1


class Sheet:
    """The sheet: `skin`, simulated with `fine` nodes; `linear`, the one-step reconstruction; `outline` and
    `description`."""

    def __init__(self, fine: int = FINE_NODES, nodes: int = NODES):
        self.outline = Rectangle(*SIDES)
        inner = Rectangle(*(side - 2 * INSET for side in SIDES))
        places = np.vstack([perimeter(inner, 16, start=inner.perimeter / 32), [[0.0, 0.0]]])
        electrodes, protocol = SheetDiscs(places, EYELET / 2, CONTACT), reference_electrode(16, current=CURRENT)
        own = material("conductive fabric")
        self.skin = PressedSkin(
            jax.random.key(0), ForwardModel(self.outline.mesh(num_points=fine), electrodes, protocol), own
        )
        model = ForwardModel(self.outline.mesh(num_points=nodes), electrodes, protocol)
        self.linear = one_step(model, own.conductivity * own.thickness)
        self.description = parse_description(
            {
                "geometry": {"shape": "rectangle", "width": SIDES[0], "height": SIDES[1]},
                "electrodes": {
                    "kind": "disc",
                    "radius": EYELET / 2,
                    "contact_impedance": CONTACT,
                    "positions": places.tolist(),
                },
                "protocol": {"kind": "reference_electrode", "current": CURRENT},
            },
            "sheet.toml",
        )

    def level(self, made: GestureSet) -> TouchLevel:
        """The noise level of images of the untouched sheet, above which touches are detected."""
        return TouchLevel.of_untouched(self.linear.mesh, np.asarray(self.linear.image(made.untouched - made.reference)))

    def touches(self, made: GestureSet) -> list[StreamTouch | None]:
        """The longest touch in each recording of a gesture set; None for a recording without a detected touch."""
        level, found = self.level(made), []
        for number in range(len(made)):
            seconds, changes = made.changes(number)
            own = find_touches(level, seconds, np.asarray(self.linear.image(changes)))
            found.append(max(own, key=lambda one: one.offset - one.onset, default=None))
        return found

    def gestures(self, people: int, each: int, seed: int, *, store: Path | None = None) -> GestureSet:
        """Gesture set with each gesture `each` times by `people` persons drawn from `seed`.

        The set is read from the folder `store` if it exists there, otherwise simulated and written there.
        """
        path = self._path("gestures", store, people, each, seed)
        if path is not None and path.exists():
            return GestureSet.read(path)
        for_people, for_touches = jax.random.split(jax.random.key(seed))
        drawn = [Person.draw(one) for one in jax.random.split(for_people, people)]
        made = simulate_gestures(for_touches, self.skin, self.outline, drawn, each)
        if path is not None:
            path.parent.mkdir(parents=True, exist_ok=True)
            made.write(path)
        return made

    def stream(self, people: int, number: int, seed: int, *, store: Path | None = None) -> GestureStream:
        """Stream of `number` gestures one after another by `people` persons drawn from `seed`, stored like the sets of
        `gestures`."""
        path = self._path("stream", store, people, number, seed)
        if path is not None and path.exists():
            with np.load(path, allow_pickle=False) as kept:
                return GestureStream(**kept)
        for_people, for_touches = jax.random.split(jax.random.key(seed))
        drawn = [Person.draw(one) for one in jax.random.split(for_people, people)]
        made = simulate_gesture_stream(for_touches, self.skin, self.outline, drawn, number)
        if path is not None:
            path.parent.mkdir(parents=True, exist_ok=True)
            np.savez_compressed(path, **vars(made))
        return made

    def _path(self, kind: str, store: Path | None, *sizes: int) -> Path | None:
        """Path of a stored set: the file name contains a hash of all parameters that determine the set; `_VERSION`
        represents the code.
        """
        if store is None:
            return None
        decides = *sizes, self.skin.model.mesh.num_cells, self.skin.material, MANNERS, _VERSION
        return store / f"{kind}-{hashlib.sha256(repr(decides).encode()).hexdigest()[:12]}.npz"
