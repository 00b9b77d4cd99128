"""Numerical methods, independent of the physics, in JAX and NumPy.

- `sparse`: symmetric sparse systems, solved directly (nested dissection, multifrontal Cholesky factorisation in batches
  of dense fronts) or by conjugate gradients, for `SparseSymmetric` operators and through `lineax.linear_solve`; and the
  underlying functions `analyse`, `factorise`, `solve`, for calls with the least overhead;
- `dense`: small dense systems in batches;
- `optimise`: descent along quadratic models, many small problems at once, problems with bounds, derivatives of a
  minimum, and `Status`;
- `kmeans`: clustering; `over_cores`, `on_cores` and `in_turn`: distribution of work.
"""

from __future__ import annotations

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
