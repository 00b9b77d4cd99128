"""`python -m jeit` runs the `jeit` command."""

from __future__ import annotations

import sys

from jeit.cli import main

if __name__ == "__main__":
    sys.exit(main())
