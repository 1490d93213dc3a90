"""Measurements of a survey that disagree with the design: wrong units, mirrored columns, exchanged points."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from itertools import combinations
from typing import Literal

import numpy as np

from calib.geometry.rigid import FloatArray
from calib.survey.alignment import Alignment, NotAligned, align, mirrored
from calib.survey.records import Survey, SurveyFinding
from calib.targets.boards import Dots

UNITS = {"feet": 3.28084, "inches": 39.3701, "centimetres": 100.0, "millimetres": 1000.0}
"""How many of them a metre has."""

SCALE = 0.03
"""Distances that differ from the design's by more than this in the median are no noise."""


def wrong_units(survey: Survey) -> Iterator[SurveyFinding]:
    """Yield what is wrong with the scale of all prisms, or of all tapes."""
    ratios = {
        "prisms": _ratio(survey.prisms_in_rover_m, survey.measured("prism").values()),
        "tapes": _ratio(survey.board.tapes_in_board_m, survey.measured("tape").values()),
    }
    off = {what: ratio for what, ratio in ratios.items() if ratio is not None and abs(ratio - 1) > SCALE}
    if len(off) == 2 and abs(off["prisms"] / off["tapes"] - 1) < SCALE:
        ratio = off["tapes"]
        yield SurveyFinding(
            "error",
            "station.csv",
            f"distances between prisms and between tapes are {ratio:.4g} times those of survey.yaml"
            + _as_unit(ratio, "station.csv is", "survey.yaml is"),
            "Write every length in metres",
        )
        return
    keys = {"prisms": "prisms_in_rover_m", "tapes": "board.tapes_in_board_m"}
    for what, ratio in off.items():
        yield SurveyFinding(
            "error",
            f"survey.yaml {keys[what]}",
            f"distances between {what} are {ratio:.4g} times as long in station.csv"
            + _as_unit(ratio, f"the {what} of station.csv are", f"{keys[what]} is"),
            "Write every length in metres, and compare with the drawing",
        )


def wrong_points(survey: Survey) -> Iterator[SurveyFinding]:
    """Yield columns that mirror the world, and points that disagree with the design."""
    sigma_m = float(np.hypot(survey.sigma.station_m, survey.sigma.prism_cad_m))
    prisms, design = survey.measured("prism"), survey.prisms_in_rover_m
    inverted = [
        s for s, seen in prisms.items() if mirrored(list(seen.values()), [design[n] for n in seen], sigma_m)
    ]
    if inverted:
        yield SurveyFinding(
            "error",
            f"station.csv, set-up {', '.join(setup for setup, _ in inverted)}",
            "the prisms fit the drawing only in a mirror: two columns of coordinates are swapped, or one has "
            "the wrong sign",
            "Write x, y and z of a right-handed frame, in this order",
        )
    for (setup, _), seen in prisms.items():
        if (setup, "") not in inverted:
            yield from _disagreement(f"set-up {setup}", "prism", design, seen, sigma_m, True)
    fitted = {(image.setup, image.placement) for image in survey.images if image.purpose != "check"}
    design, sigma_m = survey.board.tapes_in_board_m, survey.sigma.station_m
    for (setup, placement), seen in survey.measured("tape").items():
        place = f"set-up {setup}, placement {placement}"
        yield from _disagreement(place, "tape", design, seen, sigma_m, (setup, placement) in fitted)


def wrong_dots(survey: Survey) -> Iterator[SurveyFinding]:
    """Yield grids seen in a mirror, and images that share their dots."""
    flipped, first_with = [], dict[bytes, str]()
    for name, dots in survey.dots.items():
        spread = _dots_per_board(survey, dots)
        if spread is not None and np.linalg.det(spread) < 0:
            flipped.append(name)
        key = dots.pixels_px.tobytes()
        if key in first_with:
            yield SurveyFinding(
                "error",
                f"dots.csv, image {name}",
                f"its dots are the very same as those of image {first_with[key]}",
                "One is a copy: find the dots of this image again",
            )
        first_with.setdefault(key, name)
    if flipped:
        yield SurveyFinding(
            "error",
            f"dots.csv, image {flipped[0]}",
            f"{len(flipped)} of {len(survey.dots)} images show the grid in a mirror: x_px and y_px are "
            "swapped, or row and column are, or one of them counts backwards",
            "x_px is the column of the picture and y_px its row, both from the top left",
        )


def wrong_grid(survey: Survey) -> Iterator[SurveyFinding]:
    """Yield a board that is said to be larger than any image shows it; its middle would be elsewhere."""
    if len(survey.dots) < 5:  # so many together show every row and column
        return
    for what, count in (("row", survey.board.rows), ("column", survey.board.columns)):
        seen = np.concatenate([getattr(dots, f"{what}s") for dots in survey.dots.values()])
        if seen.min() > 0 or seen.max() < count - 1:
            yield SurveyFinding(
                "error",
                f"survey.yaml board.{what}s",
                f"the board has {count} {what}s, 0 to {count - 1}, but the dots of all {len(survey.dots)} "
                f"images are in {what}s {seen.min()} to {seen.max()}",
                f"Correct board.{what}s or dots.csv ({what}s count from 0), and tapes_in_board_m, which "
                "count from the middle of the grid",
            )


def _ratio(design: Mapping[str, FloatArray], groups: Iterable[Mapping[str, FloatArray]]) -> float | None:
    """Median of measured to designed distances; None if there are none, or they do not agree on one."""
    ratios = [
        float(np.linalg.norm(seen[a] - seen[b]) / np.linalg.norm(design[a] - design[b]))
        for seen in groups
        for a, b in combinations(seen, 2)
        if np.linalg.norm(design[a] - design[b]) > 0
    ]
    if not ratios:
        return None
    median = float(np.median(ratios))
    alike = np.abs(np.array(ratios) / median - 1) < SCALE / 2
    return median if alike.mean() >= 0.6 else None  # a wrong unit stretches every distance, not single ones


def _as_unit(ratio: float, measured: str, designed: str) -> str:
    """Say which unit a ratio comes from, if it is a known one."""
    for unit, in_metre in UNITS.items():
        if abs(ratio / in_metre - 1) < SCALE:
            return f": {measured} in {unit}"
        if abs(ratio * in_metre - 1) < SCALE:
            return f": {designed} in {unit}"
    return ""


def _disagreement(
    place: str,
    what: Literal["prism", "tape"],
    design: Mapping[str, FloatArray],
    seen: Mapping[str, FloatArray],
    sigma_m: float,
    tested_again: bool,
) -> Iterator[SurveyFinding]:
    """Yield which points of a group do not fit the design, and whether two names are exchanged."""
    try:
        found = _on_design(design, seen, sigma_m)
    except NotAligned:
        return
    if not found.rejected and not found.doubt:
        return
    pairs = []
    for a, b in combinations(sorted(seen), 2):
        exchanged = _on_design(design, {**seen, a: seen[b], b: seen[a]}, sigma_m)
        if not exchanged.rejected and not exchanged.doubt:
            pairs.append((a, b))
    if len(pairs) == 1:
        yield SurveyFinding(
            "error",
            place,
            f"the {what}s {pairs[0][0]} and {pairs[0][1]} are exchanged: the other way round they fit",
            "Correct the names in station.csv",
        )
    elif found.rejected:
        off_mm = 1e3 * np.linalg.norm(found.residuals_m, axis=1)
        off = [f"{name} ({off_mm[found.names.index(name)]:.0f} mm)" for name in found.rejected]
        yield SurveyFinding(
            "warning",
            place,
            f"{what} {', '.join(off)} does not fit the others and will be left out",
            f"Measure it again, with the sight on the middle of the {what}",
            tested_again,
        )
    else:
        # A sigma that is stated up to five times too small is no blunder: the fit finds it, and widens it.
        wider = _on_design(design, seen, 5.0 * sigma_m)
        needed = what == "prism"
        refused = needed and bool(wider.doubt or wider.rejected)
        yield SurveyFinding(
            "error" if refused else "warning",
            place,
            f"the {what}s do not have the drawing's shape: {found.doubt}",
            f"Measure the {what}s of this {'set-up' if needed else 'placement'} again",
            tested_again and not refused,
        )


def _on_design(design: Mapping[str, FloatArray], seen: Mapping[str, FloatArray], sigma_m: float) -> Alignment:
    return align([design[name] for name in seen], list(seen.values()), sigma_m, list(seen))


def _dots_per_board(survey: Survey, dots: Dots) -> FloatArray | None:
    """(2, 2) pixels per metre of the board's x and y, of the affine map that fits best; None on one line."""
    in_board = survey.board.dots_in_board_m(dots.rows, dots.columns)[:, :2]
    middle = in_board - in_board.mean(axis=0)
    if len(middle) < 3 or np.linalg.matrix_rank(middle, tol=1e-6) < 2:
        return None
    return np.asarray(np.linalg.lstsq(middle, dots.pixels_px - dots.pixels_px.mean(axis=0), rcond=None)[0].T)


def pixels_per_metre(survey: Survey, dots: Dots) -> float | None:
    """Return the scale of the grid along the direction in which it is not foreshortened, pixels per metre."""
    spread = _dots_per_board(survey, dots)
    return None if spread is None else float(np.linalg.norm(spread, 2))
