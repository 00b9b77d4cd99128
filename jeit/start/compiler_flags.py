"""Flags of XLA with which programs compile quickly and run a little slower: for what runs once."""

from __future__ import annotations

from importlib.metadata import version


def quick_compilation() -> str:
    """A value for the environment variable XLA_FLAGS, to be set before JAX computes anything.

    Code without optimisation takes a quarter of the time to compile. XLA ends the process at flags that it does not
    know, and they come and go.
    """
    fusion = " --xla_cpu_use_fusion_emitters=false" if version("jaxlib").startswith("0.10.") else ""
    return f"--xla_backend_optimization_level=0{fusion}"
