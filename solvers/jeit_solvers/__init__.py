"""Numerical methods, independent of the physics, in JAX and NumPy.

- `sparse`: symmetric sparse systems of `SparseSymmetric` operators, solved through `lineax.linear_solve`, either
  directly (nested dissection, multifrontal Cholesky factorisation in batches of dense fronts) or by conjugate
  gradients; the underlying functions `analyse`, `factorise` and `solve` have less overhead;
- `dense`: small dense systems in batches;
- `optimise`: descent along quadratic models, many small problems at once, problems with bounds, derivatives of a
  minimum, and `Status`;
- `kmeans`: clustering; `over_cores`, `on_cores`, `results_on_cores` and `in_turn`: distribution of work.
"""

from __future__ import annotations

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
