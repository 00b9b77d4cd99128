from .arrays import real_array
from .counts import counted, percent
from .instrument import readings
from .keys import check_key
from .kinds import check_kind, is_number, told
from .lengths import IN_MILLIMETRES, check_metres
from .names import check_name, did_you_mean, listed
from .traced import check_has_values

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
