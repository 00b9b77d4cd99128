"""`python -m jeit` is the `jeit` command."""

import sys

from jeit.cli import main

if __name__ == "__main__":
    sys.exit(main())
