"""A verdict on a calibration, and the reasons that it is made of."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Literal

Grade = Literal["good", "care", "bad"]

WORDS: Mapping[Grade, str] = {
    "good": "trust it",
    "care": "use it with care",
    "bad": "do not trust it",
}


@dataclass(frozen=True)
class Reason:
    """One test's outcome as a sentence."""

    grade: Grade
    sentence: str


@dataclass(frozen=True)
class CalibrationVerdict:
    """The worst of the reasons decides."""

    grade: Grade
    reasons: tuple[Reason, ...]

    @classmethod
    def by(cls, reasons: Iterable[Reason]) -> CalibrationVerdict:
        """Return the verdict of some reasons."""
        every = tuple(reasons)
        grades = {reason.grade for reason in every}
        return cls("bad" if "bad" in grades else "care" if "care" in grades else "good", every)

    @property
    def words(self) -> str:
        """The grade as a person says it."""
        return WORDS[self.grade]

    def as_json(self) -> dict[str, object]:
        """Return it as JSON or YAML."""
        reasons = [{"grade": reason.grade, "sentence": reason.sentence} for reason in self.reasons]
        return {"grade": self.grade, "words": self.words, "reasons": reasons}
