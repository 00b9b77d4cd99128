"""How anything is measured: contestants in processes of their own, their turns, their memory, the machine, tables."""
