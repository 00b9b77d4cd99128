"""Validation of the numeric arguments of a simulated acoustic skin and its touches."""

from __future__ import annotations

from jeit.arguments import describe, is_number


def check_positive(name: str, value: float) -> None:
    """Raises `ValueError` if `value` is not a finite number greater than zero."""
    if not (is_number(value) and value > 0):
        raise ValueError(f"{name} must be a positive number in SI units; it is {describe(value)}.")


def check_not_negative(name: str, value: float) -> None:
    """Raises `ValueError` if `value` is not a finite number greater than or equal to zero."""
    if not (is_number(value) and value >= 0):
        raise ValueError(f"{name} must be zero or positive; it is {describe(value)}.")
