"""What importing jeit sets up in JAX: double precision, and a place where compiled code is kept between runs."""

from jeit.start.compiled_code import discarded_damaged, keep_compiled_code
from jeit.start.precision import take_double_precision

__all__ = [
    "discarded_damaged",
    "keep_compiled_code",
    "take_double_precision",
]
