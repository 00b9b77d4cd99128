import jax
import jax.numpy as jnp
import lineax
import numpy as np
import optimistix as optx

from jeit_solvers import SparseSymmetric, SparsityPattern, analyse, factorise

# A chain of 50 unknowns, each coupled to the next.
chain = 2.5 * np.eye(50) - np.eye(50, k=1) - np.eye(50, k=-1)
pattern, values = SparsityPattern.from_matrix(chain)
coordinates = np.arange(50.0)[:, None]
operator = SparseSymmetric(values, pattern)
plan = analyse(pattern, coordinates)
factor = factorise(plan, jnp.asarray(values))
loads = jnp.eye(50)[:, :2]
# A dense positive definite matrix, and 100 small ones.
dense = jnp.asarray(chain[:5, :5])
small = jnp.repeat(dense[:3, :3, None], 100, axis=2)


def bowl(x):
    return jnp.sum((x - 2.0) ** 2)
