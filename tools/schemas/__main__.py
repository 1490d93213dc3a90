"""Write the JSON Schemas of the files that a person writes, taken from the readers themselves.

.venv/bin/python -m tools.schemas                   # writes configs/schemas/NAME.json
.venv/bin/python -m tools.schemas --show config     # one of them on stdout
.venv/bin/python -m tools.schemas --page docs/reference/configuration.md    # defaults and bounds there

An option of a driver with a default or a bound of its own is in them after this has run.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from tools.command import end
from tools.schemas.files import FILES, REPOSITORY, schema_of
from tools.schemas.page import generated

FOLDER = REPOSITORY / "configs" / "schemas"
WIDTH = 160


def written(value: Any, indent: str = "") -> str:
    """Return JSON with what fits on one line there, so that a change of a key is a change of a line."""
    line = json.dumps(value, ensure_ascii=False)
    if len(indent) + len(line) <= WIDTH or not isinstance(value, dict | list) or not value:
        return line
    inner = indent + " "
    if isinstance(value, list):
        return "[\n" + ",\n".join(inner + written(one, inner) for one in value) + f"\n{indent}]"
    rows = (f"{inner}{json.dumps(key)}: {written(one, inner)}" for key, one in value.items())
    return "{\n" + ",\n".join(rows) + f"\n{indent}}}"


def parser() -> argparse.ArgumentParser:
    """Return the command's parser."""
    made = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    made.add_argument("--show", choices=tuple(FILES), help="print this one and write none")
    made.add_argument("--page", type=Path, metavar="FILE", help="fill the tables of this page instead")
    made.add_argument("--folder", type=Path, default=FOLDER, help="where they go (default configs/schemas)")
    return made


def main(arguments: Sequence[str] | None = None) -> int:
    """Write or print them."""
    args = parser().parse_args(arguments)
    if args.show:
        print(written(schema_of(args.show)))
        return 0
    if args.page is not None:
        args.page.write_text(generated(args.page.read_text(encoding="utf-8")), encoding="utf-8")
        return 0
    args.folder.mkdir(exist_ok=True)
    for name in FILES:
        (args.folder / f"{name}.json").write_text(written(schema_of(name)) + "\n")
    return 0


if __name__ == "__main__":
    end(main)
