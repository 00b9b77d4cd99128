"""What is said of arguments and files that cannot be right: another kind of thing, a name there is not, a length in
millimetres.

One sentence each, before anything is compiled: which argument, what was given, what to give. Beneath all rooms, and
light: nothing of the library is imported here.
"""

from __future__ import annotations

from jeit.arguments.arrays import real_array
from jeit.arguments.counts import counted, percent
from jeit.arguments.instrument import readings
from jeit.arguments.keys import check_key
from jeit.arguments.kinds import check_kind, is_number, told
from jeit.arguments.lengths import IN_MILLIMETRES, check_metres
from jeit.arguments.names import check_name, did_you_mean, listed
from jeit.arguments.traced import check_has_values

__all__ = [
    "IN_MILLIMETRES",
    "check_has_values",
    "check_key",
    "check_kind",
    "check_metres",
    "check_name",
    "counted",
    "did_you_mean",
    "is_number",
    "listed",
    "percent",
    "readings",
    "real_array",
    "told",
]
