"""`Module`: an `equinox.Module` whose methods take less time to look up."""

from __future__ import annotations

from types import MethodType
from typing import TYPE_CHECKING, Any

import equinox as eqx

# For each function: attributes of the bound method that Equinox created, without the bound object.
_BOUND_METHOD_TYPES: dict[Any, tuple[type, dict[str, Any]]] = {}


class Module(eqx.Module):
    """An `equinox.Module` with the same methods, fields and pytree, but with quickly bound methods.

    Each time a bound method is looked up, Equinox turns it into a module, so that it can pass through transformations
    of JAX, and checks this module. This takes 40 microseconds, more than the method itself takes for a few numbers in
    NumPy. Here Equinox binds each method once. Later bound methods are copies of the first with a different object,
    which takes 1.5 microseconds.
    """

    if not TYPE_CHECKING:

        def __getattribute__(self, name: str) -> Any:
            raw_attribute = object.__getattribute__(self, name)
            if type(raw_attribute) is not MethodType or raw_attribute.__self__ is not self or name.startswith("__"):
                return raw_attribute
            cached_method_type = _BOUND_METHOD_TYPES.get(raw_attribute.__func__)
            if cached_method_type is None:
                bound_method = super().__getattribute__(name)
                bound_attributes = dict(getattr(bound_method, "__dict__", {}))
                if bound_attributes.pop("__self__", None) is self:
                    _BOUND_METHOD_TYPES[raw_attribute.__func__] = type(bound_method), bound_attributes
                return bound_method
            method_type, bound_attributes = cached_method_type
            bound_method = object.__new__(method_type)
            bound_method.__dict__.update(bound_attributes, __self__=self)
            return bound_method
