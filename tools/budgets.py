"""Count lines, modules and words of the checkout beside their budgets.

    .venv/bin/python -m tools.budgets             # the table; exit 1 where a count exceeds its budget
    .venv/bin/python -m tools.budgets --lower     # write the present, smaller counts to budgets.toml

Lines are physical lines of the *.py files that git tracks, as ``wc -l`` counts them. Words are those of the
tracked *.md files, as ``wc -w`` counts them.
"""

from __future__ import annotations

import argparse
import re
import subprocess
import tomllib
from pathlib import Path

REPOSITORY = Path(__file__).resolve().parent.parent
FILE = Path("budgets.toml")

Counts = dict[str, dict[str, int]]


def counts(repository: Path = REPOSITORY) -> Counts:
    """Return what ``budgets.toml`` limits: for each place its lines and modules, or its words and pages."""
    listed = subprocess.run(
        ["git", "ls-files", "-z"], cwd=repository, capture_output=True, text=True, check=True
    ).stdout.split("\0")
    texts = {name: repository / name for name in listed if name.endswith((".py", ".md"))}
    present = {name: path.read_text(encoding="utf-8") for name, path in texts.items() if path.is_file()}
    found: Counts = {}
    for place in ("calib", "drivers", "mastctl", "tools", "hil_tests"):
        modules = [text for name, text in present.items() if re.match(rf"{place}/.*\.py$", name)]
        found[place] = {"lines": sum(text.count("\n") for text in modules), "modules": len(modules)}
    pages = [text for name, text in present.items() if re.match(r"docs/.*\.md$", name)]
    found["docs"] = {"words": sum(len(text.split()) for text in pages), "pages": len(pages)}
    found["changelog"] = {"words": len(present["CHANGELOG.md"].split())}
    return found


def budgets(text: str) -> Counts:
    """Read the text of ``budgets.toml``."""
    return tomllib.loads(text)


def main() -> int:
    """Print the table, or lower the budgets."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument(
        "--lower", action="store_true", help="write the present, smaller counts to budgets.toml"
    )
    lower = parser.parse_args().lower
    text = (REPOSITORY / FILE).read_text(encoding="utf-8")
    allowed, present = budgets(text), counts()
    over = False
    for place, limits in allowed.items():
        for unit, limit in limits.items():
            count = present[place][unit]
            over |= count > limit
            print(f"{place:10} {unit:8} {count:7} of {limit:7}{'  EXCEEDED' if count > limit else ''}")
            if lower and count < limit:
                text = re.sub(rf"(\[{place}\][^\[]*?\b{unit} = )\d+", rf"\g<1>{count}", text)
    if lower:
        (REPOSITORY / FILE).write_text(text, encoding="utf-8")
    return int(over)


if __name__ == "__main__":
    raise SystemExit(main())
