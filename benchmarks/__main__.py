"""`python -m benchmarks`: the forward contest."""

import sys

from benchmarks.cases.forward import main

if __name__ == "__main__":
    sys.exit(main())
