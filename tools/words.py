"""Check all texts that a person reads against the rules of docs/contribute/how-we-write.md.

Pages; messages, log lines, help texts, verdicts; docstrings of public names; the operator page; reports.

    .venv/bin/python -m tools.words                  # every finding, and a total for each page and room
    .venv/bin/python -m tools.words docs/index.md    # the findings of these files
    .venv/bin/python -m tools.words --lower          # write the present, smaller counts to the budget

A program can check three rules: no sentence beyond 30 words; no bare "who" or "what" as its subject; none of
the words that the third column of docs/reference/glossary.md replaces. `BUDGET` holds how many findings each
page and each room still has. One without a row must have none.
"""

from __future__ import annotations

import argparse
import ast
import csv
import re
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

from tools.command import end

REPOSITORY = Path(__file__).parents[1]
BUDGET = Path("tools/words_budget.csv")
GLOSSARY = Path("docs/reference/glossary.md")
PACKAGES = ("calib", "drivers", "mastctl")
SPEAKING = {".py", ".html", ".js"}
LONGEST_WORDS = 30
LABEL_WORDS = 4  # "what it does" over a column has no subject

SENTENCE_END = re.compile(r"(?<!e\.g)(?<!i\.e)(?<!cf)(?<!vs)(?<=[.?!])[*_)\"]*\s+")
BARE_SUBJECT = re.compile(
    r"(?:^|[.;:,(]\s|\b(?:and|or|but|of|for|by|to|with|than|as|is|are|not|from)\s)(who|whoever)\b"
    r"|(?:^|;\s)(what|whatever)\b",
    re.IGNORECASE,
)


class Finding(NamedTuple):
    """One place that breaks a rule."""

    file: str
    line: int
    rule: str
    words: str

    @property
    def counted_under(self) -> str:
        """The row of the budget: a page, or the room of a module."""
        return self.file if self.file.endswith(".md") else "/".join(self.file.split("/")[:2])


def replaced_words(glossary: str) -> re.Pattern[str]:
    """Return a pattern of the words that the glossary's third column replaces, with their plain plurals."""
    cells = (line.split("|") for line in glossary.splitlines() if line.startswith("| "))
    words = {word for cell in cells if len(cell) == 5 for word in re.findall(r"`([^`]+)`", cell[3])}
    return re.compile(rf"\b(?:{'|'.join(sorted(map(re.escape, words)))})s?\b", re.IGNORECASE)


def findings_in(text: str, file: str, line: int, replaced: re.Pattern[str]) -> Iterator[Finding]:
    """Yield what breaks a rule in one paragraph, cell, help text or message."""
    for sentence in SENTENCE_END.split(text):
        shown = " ".join(sentence.split())
        count = sum(1 for word in shown.split() if re.search(r"[^\W\d_]", word))
        if count > LONGEST_WORDS:
            yield Finding(file, line, f"{count} words", shown)
        if count > LABEL_WORDS and not shown.endswith("?") and (found := BARE_SUBJECT.search(shown)):
            yield Finding(file, line, f"bare {(found[1] or found[2]).lower()}", shown)
        for word in replaced.findall(shown):
            yield Finding(file, line, f"word {word!r}", shown)


def page_texts(page: str) -> Iterator[tuple[int, str]]:
    """Yield line number and text of every paragraph, heading, list item and table cell of a Markdown page."""
    paragraph: list[str] = []
    start, fence, blank_before, in_list = 1, "", True, False
    page = re.sub(r"<!--.*?-->", lambda found: "\n" * found[0].count("\n"), page, flags=re.DOTALL)
    for number, line in enumerate([*page.splitlines(), ""], 1):
        mark = re.match(r"\s*(`{3,}|:{3,}|~{3,})", line)
        if mark and not fence:
            fence = mark[1]
        elif fence:
            fence = "" if mark and mark[1] == fence and line.strip() == fence else fence
            continue
        is_code = blank_before and not in_list and line.startswith("    ")
        begins = bool(re.match(r"\s*([-*+]|\d+\.)\s|#|\||>", line))
        if paragraph and (mark or not line.strip() or begins or is_code):
            yield start, _plain(" ".join(paragraph))
            paragraph = []
        if line.startswith("|"):
            yield from ((number, _plain(cell)) for cell in re.split(r"(?<!\\)\|", line)[1:-1])
        elif line.strip() and not mark and not is_code:
            start = start if paragraph else number
            paragraph.append(re.sub(r"^\s*([-*+]|\d+\.|#+|>)\s+", "", line))
        in_list = bool(re.match(r"\s*([-*+]|\d+\.)\s", line)) or (in_list and line[:1] in ("", " "))
        blank_before = not line.strip() or (is_code and blank_before)


def _plain(text: str) -> str:
    """Return a Markdown text without pictures, addresses, formulas and emphasis; code counts as one word."""
    text = re.sub(r"!\[[^\]]*\]\([^)]*\)", "", text)
    text = re.sub(r"\[([^\]]*)\]\([^)]*\)", r"\1", text)
    text = re.sub(r"\*\*([^*]*)\*\*", r"\1", text)
    return re.sub(r"`[^`]*`|\$[^$]*\$", "x", text).strip()


def code_texts(source: str) -> Iterator[tuple[int, str]]:
    """Yield line number and text of a module's docstrings of public names, and of all strings of words.

    The strings are messages, log lines, help texts, verdicts and tables.
    """
    tree = ast.parse(source)
    yield from _docstrings(tree)
    yield from _strings(tree)


def _docstrings(scope: ast.Module | ast.ClassDef) -> Iterator[tuple[int, str]]:
    """The docstrings of a module or class, of its public functions, classes and constants."""
    for before, node in zip([scope, *scope.body], scope.body, strict=False):
        if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant) and _is_public(before):
            yield from paragraphs(str(node.value.value), node.lineno)
        elif isinstance(node, ast.ClassDef) and _is_public(node):
            yield from _docstrings(node)
        elif isinstance(node, (ast.FunctionDef, ast.AsyncFunctionDef)) and _is_public(node):
            yield from paragraphs(ast.get_docstring(node) or "", node.body[0].lineno)


def _is_public(node: ast.AST) -> bool:
    if isinstance(node, ast.Assign):
        node = node.targets[0]
    if isinstance(node, ast.AnnAssign):
        node = node.target
    name = getattr(node, "name", getattr(node, "id", ""))
    return not name.startswith("_")


def paragraphs(docstring: str, line: int) -> Iterator[tuple[int, str]]:
    """Yield the paragraphs of a docstring, each line of other indentation than the one before by itself."""
    indent, begun, lines = -1, line, list[str]()
    for number, text in enumerate([*docstring.splitlines(), ""], line):
        depth = len(text) - len(text.lstrip()) if number > line or not text else indent
        if lines and (not text.strip() or (depth != indent and number > line + 1)):
            yield begun, re.sub(r"``[^`]*``|`[^`]*`", "x", " ".join(lines))
            lines = []
        if text.strip() and not re.match(r"\s*(-{3,}|>>>)", text):
            begun = begun if lines else number
            lines.append(text.strip())
        indent = depth


def _strings(node: ast.AST) -> Iterator[tuple[int, str]]:
    """Every line of the strings longer than a label, but docstrings; a value filled in counts as one word."""
    for child in ast.iter_child_nodes(node):
        if isinstance(child, ast.Expr) and isinstance(child.value, ast.Constant):
            continue
        text = _text(child) if isinstance(child, ast.expr) else ""
        if len(text.split()) > LABEL_WORDS:
            yield from ((getattr(child, "lineno", 0), line) for line in text.split("\n"))
        elif not isinstance(child, (ast.JoinedStr, ast.Constant)):
            yield from _strings(child)


def _text(node: ast.expr) -> str:
    """Return a constant or formatted text, with one letter for each value filled in; else nothing."""
    if isinstance(node, ast.Constant) and isinstance(node.value, str):
        return node.value
    if isinstance(node, ast.JoinedStr):
        return "".join(_text(part) if isinstance(part, ast.Constant) else "x" for part in node.values)
    if isinstance(node, ast.BinOp) and isinstance(node.op, ast.Add):
        return f"{_text(node.left)}{_text(node.right)}"
    return ""


def page_files_texts(text: str, suffix: str) -> Iterator[tuple[int, str]]:
    """Yield line number and text of the elements of an HTML file or template, or of a script's strings."""
    pattern = r">([^<>]+)<|(?:title|aria-label|placeholder|alt)=\"([^\"]+)\""
    if suffix == ".js":
        text = re.sub(r"(?m)^\s*(//|\*|/\*).*$|\s// .*$", "", text)
        pattern = r"\"((?:[^\"\\\n]|\\.)*)\"|`((?:[^`\\]|\\.)*)`"
    else:
        blank = r"(?s)<(script|style)\b.*?</\1>|\{#.*?#\}|\{%.*?%\}|<!--.*?-->"
        text = re.sub(blank, lambda found: "\n" * found[0].count("\n"), text)
        text = re.sub(r"\{\{.*?\}\}", "x", text)
        text = re.sub(r"</?(?:b|i|em|strong|code|a|span|abbr|sub|sup|kbd)\b[^>]*>", "", text)
    for found in re.finditer(pattern, text):
        words = re.sub(r"\$\{[^}]*\}", "x", found[1] or found[2] or "")
        if len(words.split()) > 1:
            yield text.count("\n", 0, found.start()) + 1, words


def findings(files: list[Path], root: Path = REPOSITORY) -> list[Finding]:
    """Return every finding of these pages and modules."""
    replaced = replaced_words((root / GLOSSARY).read_text(encoding="utf-8"))
    found = []
    for file in files:
        text, name = (root / file).read_text(encoding="utf-8"), file.as_posix()
        if file.suffix == ".md":
            places = page_texts(text)
        else:
            places = code_texts(text) if file.suffix == ".py" else page_files_texts(text, file.suffix)
        for line, words in places:
            found += findings_in(words, name, line, replaced)
    return found


def checked_files(root: Path = REPOSITORY) -> list[Path]:
    """Return README, every page that is written by hand, and every module of the packages."""
    pages = [page for page in (root / "docs").rglob("*.md") if not {"generated", "_build"} & {*page.parts}]
    files = (file for package in PACKAGES for file in (root / package).rglob("*") if file.suffix in SPEAKING)
    return [file.relative_to(root) for file in (root / "README.md", *sorted(pages), *sorted(files))]


def budget(root: Path = REPOSITORY) -> dict[str, int]:
    """Return how many findings each page and package may have."""
    with (root / BUDGET).open(encoding="utf-8", newline="") as file:
        return {row["place"]: int(row["findings"]) for row in csv.DictReader(file)}


def main() -> int:
    """Print the findings; return 1 where a place has more of them than its budget."""
    parser = argparse.ArgumentParser(description="Check the words of pages, code and reports.")
    parser.add_argument("files", nargs="*", type=Path, help="pages or modules; default: all of them")
    parser.add_argument("--lower", action="store_true", help="write smaller counts to the budget")
    options = parser.parse_args()
    found = findings(options.files or checked_files())
    counts, allowed = Counter(one.counted_under for one in found), budget()
    if options.lower:
        kept = {place: min(counts[place], most) for place, most in allowed.items() if counts[place]}
        rows = [f"{place},{kept[place]}\n" for place in sorted(kept)]
        (REPOSITORY / BUDGET).write_text("".join(["place,findings\n", *rows]), encoding="utf-8")
        return 0
    for one in found:
        print(f"{one.file}:{one.line}: {one.rule}: {one.words[:160]}")
    if options.files:
        return int(bool(found))
    for place, count in sorted(counts.items()):
        print(f"{count:4d} of {allowed.get(place, 0):4d}  {place}")
    print(f"{len(found)} findings")
    return int(any(count > allowed.get(place, 0) for place, count in counts.items()))


if __name__ == "__main__":
    end(main)
