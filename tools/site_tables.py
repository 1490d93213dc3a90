"""The directive ``data-table`` of the site: a CSV file beside the page as a table, with its source below.

    ```{data-table} NAME
    ```

shows ``data/NAME.csv``. Where ``data/sources.csv`` has a row for it, the command, the date and the commit are
shown below the table.
"""

from __future__ import annotations

import csv
from pathlib import Path
from typing import Any

from docutils import nodes
from sphinx.directives.patches import CSVTable


class DataTable(CSVTable):
    """A table from ``data/NAME.csv``, whose first row is the header."""

    required_arguments = 1
    option_spec = None
    has_content = False

    def run(self) -> list[nodes.Node]:
        name = self.arguments.pop()
        self.options = {"file": f"data/{name}.csv", "header-rows": 1}
        return [*super().run(), *self._source(name)]

    def _source(self, name: str) -> list[nodes.Node]:
        page = Path(self.state.document.settings.env.doc2path(self.state.document.settings.env.docname))
        sources = page.parent / "data" / "sources.csv"
        if not sources.is_file():
            return []
        with sources.open(newline="", encoding="utf-8") as file:
            rows = [row for row in csv.DictReader(file) if row["table"] == name]
        below = []
        for row in rows:
            source = nodes.paragraph(classes=["source"])
            source += nodes.literal(text=row["command"].strip("`"))
            source += nodes.Text(f", table of {row['table of']}, at commit {row['commit']}")
            below.append(source)
        return below


def setup(app: Any) -> dict[str, bool]:
    """Register the directive."""
    app.add_directive("data-table", DataTable)
    return {"parallel_read_safe": True}
