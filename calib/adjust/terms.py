"""The terms of a fit: the dots of an image, a point of the station, and the prior of lenses."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from calib.geometry.cahvor import CameraModel
from calib.geometry.parameters import parameter_names, parameter_part
from calib.geometry.rig import Rig
from calib.geometry.rigid import FloatArray, Rigid, tangents
from calib.survey.records import Survey

JOINTS, TAPES, PRISMS, DRAWING, DOTS_OF = "joint readings", "tapes", "prisms", "drawing", "dots of "
"""Kinds of measurements, each with a sigma of its own."""


@dataclass(frozen=True, eq=False)
class ImageTerm:
    """The dots or corners of one image: board points (n, 3), pixels (n, 2), their sigma (n,), and which count
    (n,).

    ``board`` is set-up and placement, of a bench board and placement; ``attitude`` the index of the head's
    standstill, None for a body camera and -1 where it is not fitted. ``approach`` says from where pan and
    tilt came to rest (+1: from smaller readings, -1: from larger, 0: not known). ``bend`` (n, 2) is what a
    bow of one moves each point by, back from the board; ``ids`` (n,) are a bench's corners. ``scatter`` is by
    what ``sigma_px`` was multiplied for this image beside others of its camera (``calib.adjust.noise``).
    """

    name: str
    camera: str
    board: tuple[str, str]
    attitude: int | None
    pan_rad: float
    tilt_rad: float
    rows: np.ndarray
    columns: np.ndarray
    in_board_m: FloatArray
    pixels_px: FloatArray
    sigma_px: FloatArray
    keep: np.ndarray
    approach: tuple[int, int] = (0, 0)
    bend: FloatArray = field(default_factory=lambda: np.zeros((0, 2)))
    ids: np.ndarray | None = None
    scatter: float = 1.0

    def part(self, index: int) -> str:
        """One of the dots or corners as a person says it."""
        if self.ids is not None:
            return f"corner {self.ids[index]}"
        return f"dot (row {self.rows[index]}, column {self.columns[index]})"

    def kept(self, good: np.ndarray) -> ImageTerm:
        """Return the image with those of its dots that count (k,) which are good."""
        keep = self.keep.copy()
        keep[keep] = good
        return replace(self, keep=keep)

    def only(self, good: np.ndarray) -> ImageTerm:
        """Return the image with some of its dots (n,), as if it had no others."""
        names = ("rows", "columns", "in_board_m", "pixels_px", "sigma_px", "keep", "bend", "ids")
        arrays = {name: getattr(self, name) for name in names}
        mine = {n: a[good] for n, a in arrays.items() if a is not None and len(a) == len(good)}
        return replace(self, **mine)

    @property
    def kind(self) -> str:
        """Which measurements have the same sigma."""
        return DOTS_OF + self.camera


@dataclass(frozen=True, eq=False)
class StationTerm:
    """One point measured by the station: a prism (``board`` None) or a tape."""

    setup: str
    board: tuple[str, str] | None
    point: str
    position_m: FloatArray
    in_board_m: FloatArray
    sigma_m: float
    keep: bool = True

    @property
    def kind(self) -> str:
        """Which measurements have the same sigma."""
        return PRISMS if self.board is None else TAPES

    @property
    def name(self) -> str:
        """The point as a person says it."""
        if self.board is None:
            return f"prism {self.point} of set-up {self.setup}"
        return f"tape {self.point} of placement {self.board[1]} (set-up {self.setup})"


def image_terms(
    survey: Survey, boards: Mapping[tuple[str, str], Rigid], notes: list[str]
) -> tuple[list[ImageTerm], list[ImageTerm], dict[tuple[object, ...], int]]:
    """Return terms of the fitted and of the check images, and the head's attitudes among the former."""
    fitted: list[ImageTerm] = []
    checks: list[ImageTerm] = []
    joints: dict[tuple[object, ...], int] = {}
    for image in survey.images:
        dots = survey.dots.get(image.name)
        if dots is None or not len(dots.rows):
            continue
        if (image.setup, image.placement) not in boards:
            notes.append(
                f"image {image.name} is not used: placement {image.placement} of set-up {image.setup} "
                "has no three tapes"
            )
            continue
        attitude = None
        on_head = survey.cameras[image.camera].on == "head"
        if on_head:
            key = (image.setup, image.placement, image.pan_rad, image.tilt_rad)
            attitude = joints.setdefault(key, len(joints)) if image.purpose != "check" else -1
        sigma = dots.sigma_px if dots.sigma_px is not None else np.full(len(dots.rows), survey.sigma.dot_px)
        term = ImageTerm(
            image.name,
            image.camera,
            (image.setup, image.placement),
            attitude,
            float(image.pan_rad or 0.0) if on_head else 0.0,
            float(image.tilt_rad or 0.0) if on_head else 0.0,
            dots.rows,
            dots.columns,
            survey.board.dots_in_board_m(dots.rows, dots.columns),
            dots.pixels_px,
            np.asarray(sigma, dtype=np.float64),
            np.ones(len(dots.rows), dtype=bool),
        )
        (checks if image.purpose == "check" else fitted).append(term)
    return fitted, checks, joints


def station_terms(survey: Survey, boards: Mapping[tuple[str, str], Rigid]) -> tuple[StationTerm, ...]:
    """Return terms of prisms and of the tapes of every board."""
    terms, sigma_m = [], survey.sigma.station_m
    for p in survey.station:
        board, places = (p.setup, p.placement), survey.board.tapes_in_board_m
        if p.kind == "prism" and p.point in survey.prisms_in_rover_m:
            terms.append(StationTerm(p.setup, None, p.point, p.position_m, np.zeros(3), sigma_m))
        elif p.kind == "tape" and board in boards and p.point in places:
            terms.append(StationTerm(p.setup, board, p.point, p.position_m, places[p.point], sigma_m))
    return tuple(terms)


def scaled_images(
    images: Sequence[ImageTerm], kinds: Mapping[str, float], own: Mapping[str, float] | None = None
) -> tuple[ImageTerm, ...]:
    """Return the terms with sigmas times factors by kind, and times what single images have besides, by
    name."""
    scaled = []
    for t in images:
        mine = (own or {}).get(t.name, 1.0)
        sigma_px = t.sigma_px * mine * kinds.get(t.kind, 1.0)
        scaled.append(replace(t, sigma_px=sigma_px, scatter=t.scatter * mine))
    return tuple(scaled)


LENS_SIGMA: Mapping[str, tuple[float, ...]] = {"O": (0.02,) * 3, "R": (0.5, 1.0), "E": (0.01,) * 3}
"""The prior of lenses, one sigma: O beside A (radians), R1 and R2, E0 to E2 (metres). Flight cameras stay
within some 2.5 of these; a survey that sees a lens well does not feel them, and one that does not cannot run
away with it."""

D_SIGMA = {"p": 0.02, "s": 0.05, "tau": 0.1, "k": 1.0}
"""The prior of OpenCV's coefficients, one sigma, by their first letter. Both parts of a ratio of polynomials
may grow together, and the picture hardly changes: k1 and k4 by the same, the others by products with these.
A fit follows that curve for hundreds of steps unless it is short; with 10 instead of 1 one Navcam did not
settle in 200, with 1 it takes 10 and leaves the same residuals."""


HARDLY = 0.7
"""A lens whose sigma stays above this part of what was known beforehand is hardly seen."""

HARDLY_ALONE = 0.5
"""The same of a coefficient: of two or three that go together, each keeps 0.6 to 0.7 of its sigma."""


def _lens_sigma(model: CameraModel) -> dict[str, FloatArray]:
    """What the numbers of a lens are usually like, one sigma each, by letter."""
    known = {letter: np.array(sigma) for letter, sigma in LENS_SIGMA.items() if letter in model.letters}
    if "D" in model.letters:
        kinds = [name.rstrip("0123456789").split("_")[0] for name in _coefficients(model.kind)]
        known["D"] = np.array([D_SIGMA[kind] for kind in kinds])
    return known


def _coefficients(kind: str) -> list[str]:
    return [name.removeprefix("D.") for name in parameter_names(kind)[parameter_part(kind, "D")]]


def lens_knowledge(model: CameraModel) -> tuple[FloatArray, FloatArray]:
    """Return how far a lens is from usual, in sigmas, and the Jacobian to the step; nothing of a CAHV."""
    kind, size = model.kind, len(parameter_names(model.kind))
    usual = {"O": model.O - model.A, "R": model.R[1:], "E": model.E, "D": model.distortion}
    residuals, rates = [np.zeros(0)], [np.zeros((0, size))]
    for letter, sigma in _lens_sigma(model).items():
        rows = np.zeros((len(sigma), size))
        rows[:, parameter_part(kind, letter)] = tangents(model.O).T if letter == "O" else np.eye(len(sigma))
        if letter == "O":
            rows[:, parameter_part(kind, "A")] = -tangents(model.A).T
        residuals.append(usual[letter] / sigma)
        rates.append(rows / sigma[:, None])
    return np.concatenate(residuals), np.concatenate(rates)


def lens_notes(rig: Rig, sigma: Mapping[str, Any]) -> tuple[str, ...]:
    """Return a sentence for what the survey hardly sees of lenses, so that usual lenses decide.

    ``sigma`` is that of ``calib.adjust.result.Calibration``.
    """
    by_parts: dict[str, list[str]] = {}
    for name, found in sigma["cameras"].items():
        model, hardly = rig.cameras[name].model, []
        for letter, usual in _lens_sigma(model).items():
            if letter == "D":
                still_open = np.array(found["distortion"]) > HARDLY_ALONE * usual
                if still_open.any():
                    hardly.append(", ".join(np.array(_coefficients(model.kind))[still_open]))
            else:  # R0 is fixed, and of E the first is the entrance point
                some = np.array(found[letter])[{"R": slice(1, None), "E": slice(1)}.get(letter, slice(None))]
                if (some > HARDLY * usual[: len(some)]).any():
                    hardly.append({"O": "lens axis", "R": "distortion", "E": "entrance point"}[letter])
        if hardly:
            by_parts.setdefault(" and ".join(hardly), []).append(name)
    return tuple(
        f"the survey hardly shows {parts} of {', '.join(names)}, so what lenses are usually like decides; "
        "pixels beyond the dots suffer"
        for parts, names in by_parts.items()
    )
