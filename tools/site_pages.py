"""Pages of the reference, written from the code at each build: commands, HTTP, codes, states, Python names.

`write_pages` fills ``docs/reference/generated``, `write_notebooks` ``docs/tutorials/generated``. Git
ignores both. Nothing here states a fact of its own.
"""

from __future__ import annotations

import argparse
import json
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import calib
from calib.errors import CalibError
from drivers import faults
from drivers.errors import DriverError
from mastctl.answers import ServiceState
from mastctl.cli.main import build_parser
from mastctl.conform.rig_checks import RIG
from mastctl.errors import MastctlError
from mastctl.testing.drivers import test_camera, test_head
from mastctl.web.app import api, description
from tools import notebooks
from tools.page_tables import page_text

PYTHON = {
    "Pointing, calibration and cameras: `calib`": ["calib"],
    "Client: `mastctl.client`": ["mastctl.client"],
    "pytest fixtures: `mastctl.testing`": ["mastctl.testing"],
    "Driver protocols: `drivers`": ["drivers.interfaces", "drivers.errors", "drivers.clock"],
}
"""Titles of the pages of Python names, and the modules whose public names stand on each."""

ROOT = Path(__file__).parents[1]
REFUSALS = ROOT / "docs" / "reference" / "http.md"
PACKAGES = ("calib", "drivers", "mastctl")
RAISED = re.compile(r'(raise \w+\(\s*)?"([a-z]+(?:_[a-z]+)*)",\s*f?"([^"]* [^"]* [^"]*)"')
"""A code and its message, where an error is raised or answered."""
BOUNDS = {"minimum": "≥", "exclusiveMinimum": ">", "maximum": "≤", "exclusiveMaximum": "<"}


def write_pages(folder: Path) -> None:
    """Write all pages; one whose text has not changed keeps its time stamp, so that builds stay quick."""
    pages = {
        "commands.md": commands_page(),
        "http-api.md": http_page(json.loads(description(api()))),
        "error-codes.md": error_codes_page(),
        "states.md": states_page(),
        "fault-words.md": fault_words_page(),
        "checks.md": checks_page(),
    }
    for title, modules in PYTHON.items():
        pages[f"python-{modules[0].replace('.', '-')}.md"] = python_page(title, modules)
    folder.mkdir(exist_ok=True)
    for name, text in pages.items():
        file = folder / name
        if not file.is_file() or file.read_text() != text:
            file.write_text(text)


def write_notebooks(folder: Path) -> None:
    """Write each notebook of a folder as a page, with its figures, into ``generated`` below it."""
    out = folder / "generated"
    out.mkdir(exist_ok=True)
    for path in sorted(folder.glob("*.ipynb")):
        notebook = notebooks.read(path)
        figures = [
            (out / f"{path.stem}-{number}.png", data)
            for number, data in enumerate(notebooks.figures(notebook))
        ]
        page = notebook_page(notebook, path.name, [name.name for name, _ in figures])
        for file, data in (*figures, (out / f"{path.stem}-notebook.md", page.encode())):
            if not file.is_file() or file.read_bytes() != data:
                file.write_bytes(data)


def notebook_page(notebook: notebooks.Notebook, name: str, figures: list[str]) -> str:
    """Return a notebook as Markdown: texts, cells, what each printed, and its figures."""
    shown = iter(figures)
    lines = []
    for cell in notebook["cells"]:
        source = "".join(cell["source"])
        if cell["cell_type"] == "markdown":
            lines += [re.sub(r"\]\((?!https?:)", "](../", source), ""]
            continue
        lines += ["```python", source, "```", ""]
        for output in cell["outputs"]:
            text = "".join(output.get("text") or output["data"].get("text/plain", []))
            if text:
                lines += ["```text", text.rstrip("\n"), "```", ""]
            elif "image/png" in output["data"]:
                lines += [f"![a figure of the notebook]({next(shown)})", ""]
    return "\n".join([*lines, f"{{download}}`Download this notebook <../{name}>`", ""])


def commands_page() -> str:
    """Return every command with its options, as `--help` has them."""
    lines = ["# Commands", ""]
    lines += ["Written from the parsers, so that it agrees with `mastctl COMMAND --help`.", ""]
    for depth, parser in _parsers(build_parser(), 1):
        lines += [f"{'#' * min(depth, 4)} `{parser.prog}`", ""] if depth > 1 else []
        lines += [_plain(parser.description or ""), ""]
        lines += ["```text", _usage(parser), "```", ""]
        rows = [row for action in parser._actions if (row := _option(action))]
        if rows:
            lines += ["| option | meaning |", "| --- | --- |", *rows, ""]
        if parser.epilog:
            lines += [_plain(parser.epilog), ""]
    return "\n".join(lines)


def _parsers(parser: argparse.ArgumentParser, depth: int) -> Iterator[tuple[int, argparse.ArgumentParser]]:
    yield depth, parser
    for action in parser._actions:
        if isinstance(action, argparse._SubParsersAction):
            for one in dict.fromkeys(action.choices.values()):
                yield from _parsers(one, depth + 1)


def _usage(parser: argparse.ArgumentParser) -> str:
    return parser.format_usage().removeprefix("usage: ").rstrip()


def _option(action: argparse.Action) -> str | None:
    if isinstance(action, (argparse._SubParsersAction, argparse._HelpAction)) or action.dest == "json":
        return None
    if action.help == argparse.SUPPRESS:
        return None
    value = action.metavar if isinstance(action.metavar, str) else action.dest.upper()
    if isinstance(action.metavar, tuple):
        value = " ".join(action.metavar)
    if action.choices:
        value = "|".join(map(str, action.choices))
    names = " or ".join(f"`{one}`" for one in action.option_strings) or f"`{value}`"
    if action.option_strings and action.nargs != 0:
        names += f" `{value}`"
    meaning = (action.help or "") % {**vars(action), "prog": ""} if action.help else ""
    return f"| {names.replace('|', chr(92) + '|')} | {_cell(meaning)} |"


def http_page(openapi: dict[str, Any]) -> str:
    """Return every path with its body, parameters and answers, as ``/openapi.json`` has them."""
    lines = ["# HTTP paths", ""]
    lines += ["Written from `/openapi.json`; [The daemon's interface](../http.md) explains them.", ""]
    for path, methods in openapi["paths"].items():
        for method, told in methods.items():
            words = told.get("description") or told.get("summary", "")
            lines += [f"## {method.upper()} {path}", "", _plain(words), ""]
            rows = [
                (f"`{one['name']}` ({one['in']})", _kind(one["schema"]), one.get("description", ""))
                for one in told.get("parameters", ())
            ]
            body = _schema(told.get("requestBody", {}), openapi)
            rows += _fields(body, "body", openapi)
            if rows:
                lines += _table("field", rows)
            codes = (f"{code} {_plain(one['description'])}" for code, one in told["responses"].items())
            lines += [f"Answers: {', '.join(codes)}.", ""]
            answer = _fields(_schema(told["responses"].get("200", {}), openapi), "", openapi)
            if answer:
                lines += _table("answer", answer)
    return "\n".join(lines)


def _table(
    first: str, rows: list[tuple[str, str, str]], second: str = "type", third: str = "meaning"
) -> list[str]:
    lines = [f"| {first} | {second} | {third} |", "| --- | --- | --- |"]
    return [*lines, *(f"| {name} | {_cell(kind)} | {_cell(words)} |" for name, kind, words in rows), ""]


def _schema(place: dict[str, Any], openapi: dict[str, Any]) -> dict[str, Any]:
    schema: dict[str, Any] = place.get("content", {}).get("application/json", {}).get("schema", {})
    return _resolved(schema, openapi)


def _resolved(schema: dict[str, Any], openapi: dict[str, Any]) -> dict[str, Any]:
    while "$ref" in schema:
        schema = openapi["components"]["schemas"][schema["$ref"].rpartition("/")[2]]
    return schema


def _fields(schema: dict[str, Any], where: str, openapi: dict[str, Any]) -> list[tuple[str, str, str]]:
    needed = set(schema.get("required", ()))
    beside = f" ({where})" if where else ""
    return [
        (
            f"`{name}`{beside}{'' if name in needed or not where else ', optional'}",
            _kind(one),
            one.get("description", ""),
        )
        for name, one in schema.get("properties", {}).items()
    ]


def _kind(schema: dict[str, Any]) -> str:
    if "$ref" in schema:
        return str(schema["$ref"].rpartition("/")[2])
    if "enum" in schema:
        return ", ".join(f"`{json.dumps(one)}`" for one in schema["enum"])
    if "const" in schema:
        return f"`{json.dumps(schema['const'])}`"
    for many in ("anyOf", "oneOf", "allOf"):
        if many in schema:
            return " or ".join(dict.fromkeys(_kind(one) for one in schema[many]))
    kind = str(schema.get("type", "any"))
    if kind == "array":
        items = schema.get("items") or (schema.get("prefixItems") or [{}])[0]
        return f"list of {_kind(items)}"
    bounds = [f"{sign} {schema[key]:g}" for key, sign in BOUNDS.items() if key in schema]
    return " ".join([kind, *bounds])


def error_codes_page() -> str:
    """Return every error code: status and remedy of the table of refusals, the meaning from the code."""
    meanings, raised = _meanings()
    section = page_text(REFUSALS).split("## Refusals", 1)[1].split("\n## ", 1)[0]
    listed: dict[str, list[tuple[str, str]]] = {}
    for status, codes, remedy in re.findall(
        r"^\| (\w+) \| ([^|]*`[^|]*) \| ([^|]*) \|", section, re.MULTILINE
    ):
        remedy = "" if status == "operation" else remedy.replace("](../", "](../../").strip()
        for code in re.findall(r"`(\w+)`", codes):
            listed.setdefault(code, []).append((status, remedy))
    lines = ["# Error codes", "", "For programs that read `error.code`. Written from the code and from"]
    lines += ["[the table of refusals](../http.md#refusals).", ""]
    lines += ["## In answers and operations", ""]
    lines += ["| code | status | meaning | remedy |", "| --- | --- | --- | --- |"]
    for code, rows in sorted(listed.items()):
        status, remedy = (", ".join(filter(None, dict.fromkeys(one))) for one in zip(*rows, strict=True))
        lines.append(f"| `{code}` | {status} | {meanings.get(code, '')} | {remedy} |")
    lines += ["", "## In commands and Python calls alone", ""]
    lines += ["The daemon answers those of the geometry, such as `blind_cone`, with status 422.", ""]
    lines += ["| code | meaning |", "| --- | --- |"]
    alone = sorted(raised - {*listed})
    return "\n".join([*lines, *(f"| `{code}` | {meanings[code]} |" for code in alone), ""])


def _meanings() -> tuple[dict[str, str], set[str]]:
    """What each code means, by its class or a message that is raised with it; and which codes are raised."""
    sources = (file.read_text(encoding="utf-8") for one in PACKAGES for file in (ROOT / one).rglob("*.py"))
    places = [found for text in sources for found in RAISED.findall(text)]
    classes = {one.code: one for one in _errors() if "code" in vars(one)}
    meanings = {code: _cell(re.sub(r"{[^}]*}", "…", message)) for _, code, message in reversed(places)}
    meanings |= {code: _cell((one.__doc__ or "").split("\n\n")[0]) for code, one in classes.items()}
    return meanings, {code for raised, code, _ in places if raised} | {*classes}


def _errors(*bases: Any) -> Iterator[Any]:
    """The errors of all modules that are imported."""
    for base in bases or (CalibError, DriverError, MastctlError):
        for kind in base.__subclasses__():
            yield kind
            yield from _errors(kind)


STATES: dict[ServiceState, str] = {
    "closing": "the daemon ends; it has sent a stop to the head",
    "stopping": "a stop was requested; the head has not confirmed it, or the operation has not ended",
    "stopped": "an emergency stop is latched: nothing moves until a reset, not even after a restart",
    "fault": "the head has a fault; the status has its cause, and the event that clears it",
    "tracking": "a track is active",
    "moving": "an operation runs, or the head moves",
    "holding": "at rest after a stop, a reset or a fault: the goal was dropped; the next command starts",
    "starting": "the head has not been read yet",
    "ready": "at rest; nothing runs",
}
"""The daemon's is the first one in this order that is true: `mastctl.control.machine.Standing`."""


def states_page() -> str:
    """Return the states of the daemon, in the order in which they count."""
    explained = "[How a stop is built](../../explanation/safety.md) explains them."
    intro = f"Of several that are true the first counts; {explained}"
    lines = ["# States", "", intro, "", "| state | meaning |", "| --- | --- |"]
    lines += [f"| `{state}` | {meaning} |" for state, meaning in STATES.items()]
    return "\n".join([*lines, ""])


def fault_words_page() -> str:
    """Return the fault words of each simulated device with their parameters."""
    explained = "[Faults on purpose](../../drivers.md#faults-on-purpose) explains them."
    lines = ["# Fault words", "", f"Written from the code; {explained}", ""]
    kinds = {"a head": faults.HEAD_WORDS, "a camera": faults.CAMERA_WORDS}
    for kind, words in kinds.items():
        rows = []
        for name, word in words.items():
            parameters = ", ".join(f"{key} {value:g}" for key, value in word.parameters.items())
            rows.append((f"`{name}`", parameters, word.does))
        lines += [f"## Of {kind}", "", *_table("word", rows, "parameters and their defaults", "effect")]
    return "\n".join(lines)


def checks_page() -> str:
    """Return the checks of a rig and the acceptance tests of drivers with their promises."""
    rows = [(f"`{one.name}`", "moves" * one.moves, one.promise) for one in RIG]
    lines = ["# Checks", "", *_table("check of a rig", rows, "head", "promise")]
    for module in (test_head, test_camera):
        tests = [(f"`{name}`", one) for name, one in vars(module).items() if name.startswith("test_")]
        rows = [(name, "moves" * hasattr(one, "pytestmark"), one.__doc__) for name, one in tests]
        lines += [f"## `{module.__name__}`", "", *_table("test", rows, "head", "promise")]
    return "\n".join(lines)


def python_page(title: str, modules: list[str]) -> str:
    """Return the directives by which autodoc writes the public names of these modules."""
    lines = [f"# {title}", ""]
    for module in modules:
        lines += ["```{eval-rst}", f".. automodule:: {module}", "   :no-members:", ""]
        if module != "calib":
            lines += [f".. automodule:: {module}", "   :members:", "   :noindex:", ""]
        else:
            for name in vars(calib)["__all__"]:
                kind = "autoclass" if isinstance(getattr(calib, name), type) else "autofunction"
                lines += [f".. {kind}:: {module}.{name}", *(["   :members:"] * (kind == "autoclass")), ""]
        lines += ["```", ""]
    return "\n".join(lines)


def _plain(text: str) -> str:
    """Return a help text as Markdown that shows every sign of it."""
    return re.sub(r"([<>*_\[\]])", r"\\\1", text.replace("%%", "%")).replace("``", "`")


def _cell(text: str) -> str:
    return _plain(" ".join(text.split())).replace("|", "\\|")
