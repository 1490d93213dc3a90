"""Run the command line as ``python -m mastctl``."""

from __future__ import annotations

from mastctl.cli.main import process

if __name__ == "__main__":
    process()
