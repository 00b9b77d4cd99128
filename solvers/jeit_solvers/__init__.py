"""Numerics with no physics in it, in pure JAX.

- `sparse`: symmetric systems by a direct solver (nested dissection, multifrontal Cholesky in batches of dense fronts)
  or conjugate gradients, for `SparseSymmetric` operators and behind `lineax.linear_solve`; and the functions beneath,
  for when every microsecond counts: `analyse`, `factorise`, `solve`;
- `dense`: small systems that batch;
- `optimise`: descent along quadratic models, many small problems at once, problems between bounds, derivatives of a
  minimum, and `Status`;
- `kmeans`; `over_cores`, `on_cores` and `in_turn`, which share work out.
"""

from __future__ import annotations

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
