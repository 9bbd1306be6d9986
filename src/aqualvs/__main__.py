"""`python -m aqualvs`."""

import sys

from aqualvs.app.cli import main

if __name__ == "__main__":
    sys.exit(main())
