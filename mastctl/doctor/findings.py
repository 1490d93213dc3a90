"""What an examination found: one thing, how good it is, a sentence, and what to do about it."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

Level = Literal["good", "unsure", "bad"]


@dataclass(frozen=True)
class Finding:
    """One thing that was looked at.

    Attributes
    ----------
    what
        What it is about, in two or three words.
    level
        ``good``; ``unsure``: works, but not as well or not for sure; ``bad``: the daemon will not work.
    sentence
        What was found.
    advice
        What a person does about it; empty where it is good.
    """

    what: str
    level: Level
    sentence: str
    advice: str = ""


@dataclass(frozen=True)
class Machine:
    """The machine that is examined; tests give it a folder of their own in place of ``/``."""

    root: Path = field(default_factory=lambda: Path("/"))

    def at(self, path: str | Path) -> Path:
        """Return where an absolute path lies."""
        return self.root / str(path).lstrip("/")

    def text(self, path: str | Path) -> str | None:
        """Return a small file's words, None if it cannot be read."""
        try:
            return self.at(path).read_text().strip()
        except (OSError, ValueError):
            return None
