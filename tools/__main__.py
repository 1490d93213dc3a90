"""List the tools of this folder, each with the first sentence of its help.

.venv/bin/python -m tools
"""

from __future__ import annotations

import ast
import sys
from pathlib import Path

FOLDER = Path(__file__).parent


def tools() -> dict[str, str]:
    """Return the tools that a person starts, and the first line of each one's docstring."""
    found = {}
    for file in sorted(FOLDER.rglob("*.py")):
        text = file.read_text(encoding="utf-8")
        if (
            file != Path(__file__)
            and 'if __name__ == "__main__"' in text
            and ("argparse" in text or "options(__doc__" in text)
        ):
            name = ".".join(file.relative_to(FOLDER).with_suffix("").parts).removesuffix(".__main__")
            found[name] = (ast.get_docstring(ast.parse(text)) or "").partition("\n")[0]
    return found


if __name__ == "__main__":
    for name, summary in tools().items():
        sys.stdout.write(f"{name:34} {summary}\n")
