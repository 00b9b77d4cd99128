"""The contestants: one file for each opponent at each kind of task, and jeit at the same tasks.

`CONTESTANTS` names those that run in processes of their own: the module, the class, and its arguments after the
problem's arrays. A contestant has `tasks` (name: function of the number of the repeat), a `description`, and may have
`details` (name: text or number) and `in_si(task, results)`.
"""

CONTESTANTS: dict[str, tuple[str, str, tuple[str, ...]]] = {
    "jeit": ("benchmarks.opponents.jeit_forward", "JeitContestant", ()),
    "scipy plain": ("benchmarks.opponents.scipy_forward", "ScipyContestant", ("plain",)),
    "scipy tuned": ("benchmarks.opponents.scipy_forward", "ScipyContestant", ("tuned",)),
    "pyeit": ("benchmarks.opponents.pyeit", "PyeitContestant", ()),
    "jeit's solver": ("benchmarks.opponents.jeit_solver", "JeitSolver", ()),
    "SuperLU": ("benchmarks.opponents.superlu", "SuperLU", ()),
    "jeit's fronts": ("benchmarks.opponents.jeit_fronts", "JeitFronts", ()),
    "jeit's multigrid": ("benchmarks.opponents.jeit_multigrid", "JeitMultigrid", ()),
    "PARDISO": ("benchmarks.opponents.pardiso", "Pardiso", ()),
    "sparsax": ("benchmarks.opponents.sparsax", "Sparsax", ()),
}
