"""Questions about a rig at a terminal; without one the usual answers are used."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from typing import TextIO

from mastctl import signals


class Prompts:
    """Asks on stderr and reads stdin, if both are a terminal."""

    def __init__(
        self, source: TextIO | None = None, out: TextIO | None = None, terminal: bool | None = None
    ) -> None:
        self._source, self._out = source or sys.stdin, out or sys.stderr
        self.terminal = (source is None and signals.can_ask()) if terminal is None else terminal

    def number(self, question: str, usual: float, low: float, high: float) -> float:
        """Return a number from low to high; an empty answer is the usual one."""
        while (text := self._answer(question, f"{usual:g}")) != "":
            try:
                value = float(text)
            except ValueError:
                value = float("nan")
            if low <= value <= high:
                return value
            self._say(f"a number from {low:g} to {high:g} is expected")
        return usual

    def one_of(self, question: str, choices: Sequence[str], usual: str) -> str:
        """Return one of the choices; an empty answer is the usual one."""
        while (text := self._answer(f"{question} ({', '.join(choices)})", usual)) != "":
            if text in choices:
                return text
            self._say(f"one of {', '.join(choices)} is expected")
        return usual

    def _answer(self, question: str, usual: str) -> str:
        """The line that was typed; empty for the usual answer, at the end of input, without a terminal."""
        if not self.terminal:
            return ""
        self._out.write(f"{question} [{usual}]: ")
        self._out.flush()
        return self._source.readline().strip()

    def _say(self, sentence: str) -> None:
        self._out.write(f"{sentence}\n")
