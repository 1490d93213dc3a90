"""Installs the browser of the page's tests and pictures if there is none: Debian's chromium without a screen.

.venv/bin/python -m tools.browser
"""

from __future__ import annotations

import shutil
import sys

from hil_tests.support.virtual_machine.apt import Busy, apt_get
from tools.command import end, options

NAMES = ("chromium-headless-shell", "chromium", "chromium-browser")
"""The first draws no window of its own, in a third less processor time, and is half the download."""


def chromium() -> str | None:
    """Return the path of the machine's chromium, None where there is none."""
    return next((found for name in NAMES if (found := shutil.which(name))), None)


def main() -> int:
    """Install it, and print where it is."""
    options(__doc__, seed=None, tasks=False).parse_args()
    if chromium() is None:
        if shutil.which("apt-get") is None:
            print("no chromium, and no apt-get to install it by", file=sys.stderr)
            return 1
        install = "install", "-y", "--no-install-recommends"
        for arguments in (("update",), (*install, NAMES[0]), (*install, NAMES[1])):
            try:
                done = apt_get(*arguments, tell=lambda words: print(words, file=sys.stderr))
            except Busy as busy:
                print(busy, file=sys.stderr)
                return 1
            if chromium() is not None:
                break
            if done.returncode != 0:
                print(f"apt-get {' '.join(arguments)}: {done.stderr.strip()[-400:]}", file=sys.stderr)
        if chromium() is None:
            return 1
    print(chromium())
    return 0


if __name__ == "__main__":
    end(main)
