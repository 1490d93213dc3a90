"""Check pages, help texts and error messages against the rules of docs/contribute/how-we-write.md.

    .venv/bin/python -m tools.words                  # every finding, and a total for each page and package
    .venv/bin/python -m tools.words docs/index.md    # the findings of these files
    .venv/bin/python -m tools.words --lower          # write the present, smaller counts to the budget

A program can check three rules: no sentence beyond 30 words; no bare "who" or "what" as its subject; none of
the words that the third column of docs/reference/glossary.md replaces. `BUDGET` holds how many findings each
page and each package still has. A page without a row must have none.
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
LONGEST_WORDS = 30
LABEL_WORDS = 4  # "what it does" over a column has no subject
HELP = ("help", "description", "epilog")

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
        """The row of the budget: a page, or the package of a module."""
        return self.file if self.file.endswith(".md") else self.file.partition("/")[0]


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
    """Yield line number and text of the help texts and raised messages of a module."""
    if "raise " not in source and "help=" not in source:
        return
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Raise) and isinstance(node.exc, ast.Call):
            yield from _messages(node.exc)
        elif isinstance(node, ast.Call):
            yield from ((k.value.lineno, t) for k in node.keywords if k.arg in HELP and (t := _text(k.value)))


def _messages(call: ast.Call) -> Iterator[tuple[int, str]]:
    for value in (*call.args, *(keyword.value for keyword in call.keywords)):
        text = _text(value)
        if " " in text:  # a code is one word
            yield value.lineno, text


def _text(node: ast.expr) -> str:
    """Return a constant or formatted text, with one letter for each value filled in; else nothing."""
    if isinstance(node, ast.Constant) and isinstance(node.value, str):
        return node.value
    if isinstance(node, ast.JoinedStr):
        return "".join(_text(part) if isinstance(part, ast.Constant) else "x" for part in node.values)
    if isinstance(node, ast.BinOp) and isinstance(node.op, ast.Add):
        return _text(node.left) + _text(node.right)
    return ""


def findings(files: list[Path], root: Path = REPOSITORY) -> list[Finding]:
    """Return every finding of these pages and modules."""
    replaced = replaced_words((root / GLOSSARY).read_text(encoding="utf-8"))
    found = []
    for file in files:
        text, name = (root / file).read_text(encoding="utf-8"), file.as_posix()
        places = page_texts(text) if file.suffix == ".md" else code_texts(text)
        for line, words in places:
            found += findings_in(words, name, line, replaced)
    return found


def checked_files(root: Path = REPOSITORY) -> list[Path]:
    """Return README, every page that is written by hand, and every module of the packages."""
    pages = [page for page in (root / "docs").rglob("*.md") if not {"generated", "_build"} & {*page.parts}]
    modules = (module for package in PACKAGES for module in (root / package).rglob("*.py"))
    return [file.relative_to(root) for file in (root / "README.md", *sorted(pages), *sorted(modules))]


def budget(root: Path = REPOSITORY) -> dict[str, int]:
    """Return how many findings each page and package may have."""
    with (root / BUDGET).open(encoding="utf-8", newline="") as file:
        return {row["place"]: int(row["findings"]) for row in csv.DictReader(file)}


def main() -> int:
    """Print the findings; return 1 where a place has more of them than its budget."""
    parser = argparse.ArgumentParser(description="Check the words of pages, help texts and messages.")
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
