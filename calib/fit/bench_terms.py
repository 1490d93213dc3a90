"""A bench's measurements as the fit takes them: the corners of an image, the head's standstills."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from calib.fit.terms import ImageTerm
from calib.survey import Survey, SurveyImage

SUREST = 0.1
"""Part of ``corner_px`` below which no corner's own sigma counts: what neighbours share is not in it."""

FEWEST_CORNERS = 6
"""An image with fewer takes no part: with four, a pose goes through them whatever they are."""


@dataclass(frozen=True, eq=False)
class BenchTerms:
    """Images that are fitted, those that are not (purpose ``check``), the number of the head's standstills
    among the former, and sentences on images that say nothing."""

    images: tuple[ImageTerm, ...]
    checks: tuple[ImageTerm, ...]
    attitudes: int
    notes: tuple[str, ...]


def bench_terms(survey: Survey) -> BenchTerms:
    """Return a bench's terms, in the order in which its images were taken.

    Images of several cameras that follow each other at one placement and reading belong to one standstill:
    what a reading is off is the same for all of them.
    """
    fitted: list[ImageTerm] = []
    checks: list[ImageTerm] = []
    notes: list[str] = []
    standstills = _Standstills()
    for image in survey.images:
        corners = survey.corners.get(image.name)
        if corners is None or not len(corners.ids):
            continue
        if len(corners.ids) < FEWEST_CORNERS:
            notes.append(
                f"image {image.name} is not used: it shows {len(corners.ids)} corners of board "
                f"{image.board}, {FEWEST_CORNERS} at least are expected"
            )
            continue
        on_head = survey.cameras[image.camera].on == "head"
        check = image.purpose == "check"
        attitude = None if not on_head else -1 if check else standstills.of(image)
        board = survey.boards[image.board]
        bend = np.stack(
            [board.in_board_m(corners.ids, bow)[:, 2] for bow in ((1.0, 0.0), (0.0, 1.0))], axis=1
        )
        term = ImageTerm(
            image.name,
            image.camera,
            (image.board, image.placement),
            attitude,
            float(image.pan_rad or 0.0) if on_head else 0.0,
            float(image.tilt_rad or 0.0) if on_head else 0.0,
            np.zeros(0, dtype=np.int64),
            np.zeros(0, dtype=np.int64),
            board.in_board_m(corners.ids),
            corners.pixels_px,
            np.maximum(corners.sigma_px, SUREST * survey.sigma.corner_px),
            np.ones(len(corners.ids), dtype=bool),
            (image.pan_approach, image.tilt_approach) if on_head else (0, 0),
            bend,
            corners.ids,
        )
        (checks if check else fitted).append(term)
    return BenchTerms(tuple(fitted), tuple(checks), standstills.count, tuple(notes))


class _Standstills:
    """Counts the head's standstills as images go by."""

    def __init__(self) -> None:
        self.count = 0
        self._key: tuple[object, ...] | None = None
        self._shown: set[tuple[str, str]] = set()

    def of(self, image: SurveyImage) -> int:
        """The index of the standstill that an image belongs to."""
        key = (image.placement, image.pan_rad, image.tilt_rad, image.pan_approach, image.tilt_approach)
        if key != self._key or (image.camera, image.board) in self._shown:
            self.count, self._key, self._shown = self.count + 1, key, set()
        self._shown.add((image.camera, image.board))
        return self.count - 1
