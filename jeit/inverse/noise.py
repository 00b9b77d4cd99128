"""How much each channel is to be trusted."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float


@jax.jit
def relative_noise(
    voltages: Float[Array, " M"], mask: Bool[Array, " M"] | None = None, *, relative: float = 0.01, floor: float = 0.3
) -> Float[Array, " M"]:
    """Standard deviation of channels whose errors grow with what they read: relative · √(v² + (floor · median|v|)²).

    What spoils a difference image of a real tank is rarely the voltmeter: gains, electrode shapes and depth that the
    model lacks leave errors in proportion to the voltage, largest where the driven electrodes are read. `voltages` (M,)
    of the reference, volts; `mask`: True for usable channels, the others do not count in the median and come out as 1.
    """
    size = jnp.abs(jnp.asarray(voltages))
    used = jnp.isfinite(size) if mask is None else jnp.asarray(mask) & jnp.isfinite(size)
    typical = jnp.nanmedian(jnp.where(used, size, jnp.nan))
    return jnp.where(used, relative * jnp.sqrt(jnp.where(used, size, 0) ** 2 + (floor * typical) ** 2), 1.0)
