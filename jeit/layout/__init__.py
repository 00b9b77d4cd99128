"""Where electrodes are: arrangements as arrays of positions, and `Layout`, a design with sizes, labels and an outline.

Arrangements: `ring`, `ring_and_centre`, `perimeter`, `grid`, `quasi_uniform`. Layouts: `named_layout`, or from and to a
CSV, DXF or SVG file (`read_layout`, `write_layout`).
"""

from jeit.layout.arrangements import grid as grid
from jeit.layout.arrangements import perimeter as perimeter
from jeit.layout.arrangements import quasi_uniform as quasi_uniform
from jeit.layout.arrangements import ring as ring
from jeit.layout.arrangements import ring_and_centre as ring_and_centre
from jeit.layout.files import read_layout as read_layout
from jeit.layout.files import write_layout as write_layout
from jeit.layout.layout import Layout as Layout
from jeit.layout.names import BUILT_IN as BUILT_IN
from jeit.layout.names import named_layout as named_layout
