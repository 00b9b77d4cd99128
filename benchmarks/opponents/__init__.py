"""The contestants: one module for each opponent and kind of task, and modules in which jeit solves the same tasks.

`CONTESTANTS` names the contestants that run in separate processes: the module, the class, and the arguments of the
class after the problem's arrays. A contestant has `tasks` (for each name of a task, a function of the number of the
repeat), a `description`, and may have `details` (text or number by name) and a method `in_si(task, results)` that
converts results to SI units.
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
