"""Run the command line as ``python -m mastctl``."""

from __future__ import annotations

import sys

from mastctl.cli.main import main

if __name__ == "__main__":
    sys.exit(main())
