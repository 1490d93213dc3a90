"""The Object Description Language of PDS3 labels: ``KEYWORD = value``, groups and objects, up to ``END``.

Values: integers (also ``2#0101#``), reals, words, quoted text (line breaks inside become one blank), a number
with a ``<unit>``, sequences ``(1, 2)`` and sets ``{A, B}``. Dates and times stay words. Source: PDS Standards
Reference 3.8, chapter 12. One pass with one pattern: time and memory grow as the text does, depth is bounded.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple, NoReturn

from calib.errors import BadFile

MAX_DEPTH = 16
_MAX_DIGITS = 400


class Quantity(NamedTuple):
    """A number with its unit, as the label writes it (``rad``, ``deg``, ``BYTES``)."""

    value: float | int
    unit: str


@dataclass(frozen=True)
class LabelBlock:
    """A group or object of a label, or the whole label.

    Attributes
    ----------
    kind, name
        ``GROUP`` or ``OBJECT`` and its name; both '' for the whole label.
    values
        Keyword to int, float, str, Quantity, or a tuple of these. The first, where a keyword is there twice.
    blocks
        The blocks inside, in the label's order.
    """

    kind: str
    name: str
    values: Mapping[str, Any] = field(default_factory=dict)
    blocks: tuple[LabelBlock, ...] = ()

    def every(self) -> Iterator[LabelBlock]:
        """Give every block inside, at any depth, in the label's order."""
        for block in self.blocks:
            yield block
            yield from block.every()


_TOKEN = re.compile(
    r"""(?P<blank>\s+|/\*.*?\*/)
      | "(?P<text>[^"]*)"
      | '(?P<symbol>[^'\r\n]*)'
      | <(?P<unit>[^<>\r\n]*)>
      | (?P<based>[-+]?\d+\#[0-9A-Za-z]+\#)
      | (?P<mark>[=(){},;])
      | (?P<word>(?:[^\s=(){},;"'<>/]|/(?!\*))+)""",
    re.VERBOSE | re.DOTALL,
)
_INT = re.compile(r"[-+]?\d+")
_REAL = re.compile(r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?")
_OPEN = {"GROUP": "GROUP", "BEGIN_GROUP": "GROUP", "OBJECT": "OBJECT", "BEGIN_OBJECT": "OBJECT"}
_CLOSE = {"END_GROUP": "GROUP", "END_OBJECT": "OBJECT"}
_CLOSING = {"(": ")", "{": "}"}


def parse_label(text: str, path: str | Path) -> LabelBlock:
    """Return the label at the beginning of the text; everything after its ``END`` is ignored.

    Raises
    ------
    BadFile
        If the text is no label or has no ``END``: at which line, what is there, what is expected.
    """
    return _Parser(text, path).label()


def number_in(block: LabelBlock, key: str, path: str | Path) -> float:
    """Return a keyword's number of at most 1e9 in size, its unit left out; raises BadFile."""
    value = block.values.get(key)
    value = value.value if isinstance(value, Quantity) else value
    if not isinstance(value, (int, float)) or not abs(value) <= 1e9:
        raise BadFile(path, f"{block.name}.{key}", f"{shown(value)} where a number up to 1e9 is expected")
    return float(value)


def integer_in(block: LabelBlock, key: str, path: str | Path, low: int, high: int) -> int:
    """Return a keyword's integer from low to high, its unit left out; raises BadFile."""
    value = block.values.get(key)
    value = value.value if isinstance(value, Quantity) else value
    if not isinstance(value, int) or not low <= value <= high:
        place = f"{block.name}.{key}" if block.name else key
        raise BadFile(path, place, f"{shown(value)} where an integer from {low} to {high} is expected")
    return value


def vector_in(block: LabelBlock, key: str, path: str | Path) -> list[float]:
    """Return a keyword's three numbers, their units left out; raises BadFile."""
    value = block.values.get(key)
    items = value if isinstance(value, tuple) and not isinstance(value, Quantity) else ()
    numbers = [item.value if isinstance(item, Quantity) else item for item in items]
    if len(numbers) != 3 or not all(isinstance(n, (int, float)) and abs(n) <= 1e9 for n in numbers):
        raise BadFile(path, f"{block.name}.{key}", f"{shown(value)} where three numbers are expected")
    return [float(n) for n in numbers]


def shown(value: Any) -> str:
    """Return a value as a refusal shows it."""
    return "nothing" if value is None else f"{value!r:.60}"


class _Parser:
    """Reads one label; ``kind`` and ``word`` are the token at hand."""

    def __init__(self, text: str, path: str | Path) -> None:
        self.text = text
        self.path = path
        self.start = self.end = 0
        self.kind = self.word = ""
        self.step()

    def step(self) -> None:
        """Go to the next token that is no blank or comment; at the end of the text its kind is ''."""
        while True:
            self.start = self.end
            match = _TOKEN.match(self.text, self.end)
            if match is None:
                if self.end < len(self.text):
                    self.fail("a value is expected")
                self.kind = self.word = ""
                return
            self.end = match.end()
            self.kind = str(match.lastgroup)
            self.word = match[self.kind]
            if self.kind != "blank":
                return

    def fail(self, expected: str) -> NoReturn:
        """Refuse the token at hand."""
        line = self.text.count("\n", 0, self.start) + 1
        found = self.text[self.start : self.start + 20].split("\n")[0].strip()
        what = repr(found) if found else "the end of the label"
        raise BadFile(self.path, f"line {line}", f"{what} where {expected}")

    def is_mark(self, mark: str) -> bool:
        return self.kind == "mark" and self.word == mark

    def label(self) -> LabelBlock:
        """Read statements up to END."""
        stack: list[tuple[str, str, dict[str, Any], list[LabelBlock]]] = [("", "", {}, [])]
        while True:
            if self.kind != "word":
                self.fail("a keyword or END is expected")
            keyword = self.word
            if keyword == "END" and len(stack) == 1:
                kind, name, values, blocks = stack[0]
                return LabelBlock(kind, name, values, tuple(blocks))
            self.step()
            if keyword in _CLOSE:
                kind, name, values, blocks = stack[-1]
                if kind != _CLOSE[keyword]:
                    self.fail(f"no {_CLOSE[keyword]} is open to be ended")
                if self.is_mark("="):
                    self.step()
                    if self.word != name:
                        self.fail(f"the end of {kind} {name[:40]} is expected")
                    self.step()
                stack.pop()
                stack[-1][3].append(LabelBlock(kind, name, values, tuple(blocks)))
                continue
            if not self.is_mark("="):
                self.fail(f"'=' is expected after {keyword[:40]}")
            self.step()
            if keyword in _OPEN:
                if self.kind not in ("word", "text", "symbol"):
                    self.fail(f"the name of a {_OPEN[keyword]} is expected")
                if len(stack) > MAX_DEPTH:
                    self.fail(f"no more than {MAX_DEPTH} groups in one another are expected")
                stack.append((_OPEN[keyword], self.word, {}, []))
                self.step()
            else:
                value = self.value(0)
                stack[-1][2].setdefault(keyword, value)
            if self.is_mark(";"):
                self.step()

    def value(self, depth: int) -> Any:
        """Read a value, and the unit after a number."""
        if self.kind == "mark" and self.word in _CLOSING:
            return self.sequence(depth)
        if self.kind == "text":
            value: Any = " ".join(self.word.split())
        elif self.kind == "based":
            base, digits, _ = self.word.split("#")
            try:
                value = int(digits, int(base))
            except ValueError:
                self.fail("a number with a base from 2 to 36 is expected")
        elif self.kind == "word" and len(self.word) <= _MAX_DIGITS and _INT.fullmatch(self.word):
            value = int(self.word)
        elif self.kind == "word" and len(self.word) <= _MAX_DIGITS and _REAL.fullmatch(self.word):
            value = float(self.word)
        elif self.kind in ("word", "symbol"):
            value = self.word
        else:
            self.fail("a value is expected")
        self.step()
        if self.kind == "unit" and not isinstance(value, str):
            value = Quantity(value, self.word.strip())
            self.step()
        return value

    def sequence(self, depth: int) -> tuple[Any, ...]:
        """Read a sequence or a set."""
        if depth == MAX_DEPTH:
            self.fail(f"no more than {MAX_DEPTH} sequences in one another are expected")
        closing = _CLOSING[self.word]
        self.step()
        items = []
        while not self.is_mark(closing):
            items.append(self.value(depth + 1))
            if self.is_mark(","):
                self.step()
            elif not self.is_mark(closing):
                self.fail(f"',' or '{closing}' is expected")
        self.step()
        return tuple(items)
