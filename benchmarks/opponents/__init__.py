"""Who competes: one file for each opponent at each kind of task, and jeit's own turn at the same."""
