"""Measurements of a survey that disagree with its design or with each other.

Wrong units, mirrored columns, exchanged points; images that cannot show the board they name, and joint angles
with the wrong sign, or exchanged. A mast whose tilt counts downwards fits a survey as well as the true one,
with its head turned by half a turn: no residual shows it. The station does: the boards then stand where the
head does not look.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from itertools import combinations, product
from typing import Literal, NamedTuple

import numpy as np

from calib.geometry.rigid import FloatArray, Rigid
from calib.survey.alignment import Alignment, NotAligned, align, mirrored, poses
from calib.survey.records import Survey, SurveyCamera, SurveyFinding, SurveyImage
from calib.targets.boards import Dots

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
    """Yield images that share their dots, and grids that are seen in a mirror."""
    first_with: dict[bytes, str] = {}
    for name, dots in survey.dots.items():
        first = first_with.setdefault(dots.pixels_px.tobytes(), name)
        if first != name:
            yield SurveyFinding(
                "error",
                f"dots.csv, image {name}",
                f"its dots are the very same as those of image {first}",
                "One is a copy: find the dots of this image again",
            )
    spreads = {name: _dots_per_board(survey, dots) for name, dots in survey.dots.items()}
    flipped = [name for name, spread in spreads.items() if spread is not None and np.linalg.det(spread) < 0]
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
    in_a_metre = {"feet": 3.28084, "inches": 39.3701, "centimetres": 100.0, "millimetres": 1000.0}
    for unit, in_metre in in_a_metre.items():
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
    if found.agrees:
        return
    pairs = [
        (a, b)
        for a, b in combinations(sorted(seen), 2)
        if _on_design(design, {**seen, a: seen[b], b: seen[a]}, sigma_m).agrees
    ]
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
        needed = what == "prism"
        refused = needed and not _on_design(design, seen, 5.0 * sigma_m).agrees
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


SIZE = 1.45
"""How much lens, lean and focal length may change the size of a board."""


class BoardBearing(NamedTuple):
    """Where an image's board is, seen from about where its camera is: to the right, upwards, and how far."""

    image: SurveyImage
    right_rad: float
    up_rad: float
    range_m: float


def sights(survey: Survey) -> dict[str, list[BoardBearing]]:
    """Return by camera the images whose board's place prisms and tapes determine."""
    boards, cameras_m = _rover_from_boards(survey), _cameras_in_rover_m(survey)
    found: dict[str, list[BoardBearing]] = {name: [] for name in survey.cameras}
    for image in survey.images:
        pose = boards.get((image.setup, image.placement))
        if pose is not None:
            away = pose.translation_m - cameras_m[image.camera]
            right, up = np.arctan2(away[1], away[0]), np.arctan2(-away[2], np.hypot(away[0], away[1]))
            found[image.camera].append(
                BoardBearing(image, float(right), float(up), float(np.linalg.norm(away)))
            )
    return found


def mixups(survey: Survey) -> Iterator[SurveyFinding]:
    """Yield boards that face away, and images that disagree with the others of their camera.

    The direction of the board is compared with the angle of pan, and its distance with the size of the grid
    in the image. Each is taken against the camera's median, so neither mounting nor focal length matters.
    """
    yield from _facing_away(_rover_from_boards(survey), _cameras_in_rover_m(survey))
    for name, mine in sights(survey).items():
        yield from _camera_mixups(survey, survey.cameras[name], mine)


def _rover_from_boards(survey: Survey) -> dict[tuple[str, str], Rigid]:
    """Where boards are, by set-up and placement; nothing is left out that does not fit."""
    rover, boards = poses(survey, "prism", 0.0), poses(survey, "tape", 0.0)
    return {
        (setup, placement): of_setup.b_from_a @ board.b_from_a
        for (setup, placement), board in boards.items()
        if isinstance(board, Alignment) and isinstance(of_setup := rover.get((setup, "")), Alignment)
    }


def _cameras_in_rover_m(survey: Survey) -> dict[str, FloatArray]:
    """About where each camera is, (3,) metres."""
    middle = np.mean(list(survey.prisms_in_rover_m.values()), axis=0)
    return {
        name: middle if camera.rough_C_m is None else camera.rough_C_m
        for name, camera in survey.cameras.items()
    }


def _facing_away(
    boards: Mapping[tuple[str, str], Rigid], cameras_m: Mapping[str, FloatArray]
) -> Iterator[SurveyFinding]:
    """Yield boards that turn their back on the rover."""
    middle_m = np.mean(list(cameras_m.values()), axis=0)
    for (setup, placement), pose in boards.items():
        towards = pose.translation_m - middle_m
        cosine = float(pose.rotation[:, 2] @ towards / max(float(np.linalg.norm(towards)), 1e-9))
        if cosine < -0.2:
            angle_deg = float(np.degrees(np.arccos(min(-cosine, 1.0))))
            yield SurveyFinding(
                "error",
                f"set-up {setup}, placement {placement}",
                f"the tapes say that the board turns its back to the rover ({angle_deg:.0f} degrees from "
                "straight away)",
                "Two tapes are exchanged (seen from the front, x goes right, y down, z into the board), or "
                "in tapes_in_board_m; correct the names",
            )


def _camera_mixups(survey: Survey, camera: SurveyCamera, mine: list[BoardBearing]) -> Iterator[SurveyFinding]:
    # how far it may be from where it is assumed: the middle of the prisms, or its rough place
    off_m = 1.0 if camera.rough_C_m is None else 0.25
    seen, sizes = [], []
    for sight in mine:
        dots = survey.dots.get(sight.image.name)
        spread = None if dots is None else _dots_per_board(survey, dots)
        if spread is not None:
            seen.append(sight)
            # in px/m, along the direction in which the grid is not foreshortened
            sizes.append(float(np.linalg.norm(spread, 2)) * sight.range_m / camera.focal_px)
    if len(seen) < 3:
        return
    aside = [sight.right_rad - (sight.image.pan_rad or 0.0) for sight in seen]
    usual_size = float(np.median(sizes))
    usual_aside = float(
        np.angle(np.median(np.exp(1j * np.array(aside)).real) + 1j * np.median(np.sin(aside)))
    )
    doubtful: list[tuple[SurveyImage, str]] = []
    for (image, _, _, range_m), angle, size in zip(seen, aside, sizes, strict=True):
        reasons = []
        off_rad = float(np.abs(np.angle(np.exp(1j * (angle - usual_aside)))))
        if image.pan_rad is not None and off_rad > _reach_rad(camera, image, range_m, off_m):
            reasons.append(f"its board is {np.degrees(off_rad):.0f} degrees aside of where pan looks")
        off = max(size / usual_size, usual_size / size)
        if off > SIZE * (1 + off_m / max(range_m, off_m)):
            larger = "larger" if size > usual_size else "smaller"
            reasons.append(f"its dots are {off:.1f} times {larger} than a board at {range_m:.1f} m shows")
        if reasons:
            doubtful.append((image, " and ".join(reasons)))
    if len(doubtful) > 0.5 * len(seen):  # not the names are at fault but a sign, a column or a length
        yield SurveyFinding(
            "error",
            f"camera {camera.name}",
            f"{len(doubtful)} of {len(seen)} images cannot show the board they name, "
            f"e.g. {doubtful[0][0].name}: {doubtful[0][1]}",
            "Check the sign of pan (right is positive), its unit, and the placements in images.csv",
        )
        return
    for image, reason in doubtful:
        yield SurveyFinding(
            "warning",
            f"images.csv line {image.row}, image {image.name}",
            f"it cannot show placement {image.placement}: {reason}",
            "Two boards may be mixed up: check the placement of this image, and the tapes of the placement",
        )
    range_m = float(np.median([sight.range_m for sight in seen]))
    off = max(usual_size, 1 / usual_size)
    if off > SIZE * (1 + off_m / max(range_m, off_m)):
        yield SurveyFinding(
            "error" if off > 2.5 else "warning",
            f"camera {camera.name}",
            f"its boards look {usual_size:.2f} times as large as focal_px {camera.focal_px:g} and "
            f"board.spacing_m say, which would fit a focal length of {usual_size * camera.focal_px:.0f} px",
            "Correct focal_px, or spacing_m if all cameras say so (a foot is 0.3048 m)",
        )


def _reach_rad(camera: SurveyCamera, image: SurveyImage, range_m: float, off_m: float) -> float:
    """How far aside of pan a board can be and still be seen."""
    half_view = float(np.arctan2(np.hypot(*camera.size_px) / 2, camera.focal_px))
    down = abs(image.tilt_rad or 0.0) + half_view
    if down > np.radians(75):
        return float(np.pi)
    across = half_view / float(np.cos(down))
    return across + float(np.arcsin(min(1.0, 1.5 * off_m / range_m))) + 0.15


def joint_mixups(survey: Survey) -> Iterator[SurveyFinding]:
    """Yield one error if pan and tilt, with another sign or exchanged, look far better at the boards."""
    # Of the images for which the head was turned to the board; those for the camera show it in corners.
    turned = [
        [one for one in mine if one.image.purpose != "camera" and one.image.pan_rad is not None]
        for mine in sights(survey).values()
    ]
    turned = [mine for mine in turned if len(mine) >= 4]  # a mean takes the mounting out
    if not turned:
        return
    joints = [np.array([(i.pan_rad, i.tilt_rad) for i, *_ in mine], dtype=np.float64) for mine in turned]
    boards = [np.array([(one.right_rad, one.up_rad) for one in mine]) for mine in turned]
    # Right of the board, then up: how far boards spread about +pan, -pan, +tilt, -tilt.
    spreads = [
        {
            (column, sign): _spread_rad([sign * j[:, column] for j in joints], [b[:, axis] for b in boards])
            for column, sign in product((0, 1), (1, -1))
        }
        for axis in (0, 1)
    ]
    best = [min(spread, key=spread.__getitem__) for spread in spreads]
    if [column for column, _ in best] != [1, 0]:
        best = [min(((axis, 1), (axis, -1)), key=spreads[axis].__getitem__) for axis in (0, 1)]
    given = [spreads[axis][axis, 1] for axis in (0, 1)]
    better = [spreads[axis][best[axis]] for axis in (0, 1)]
    # a spread of 0.1 rad says nothing: boards stand anywhere in the picture
    wrong = [g > 0.1 and b < 0.6 * g for g, b in zip(given, better, strict=True)]
    if best[0][0] == 1:
        faults = ["pan_rad and tilt_rad are exchanged"] if all(wrong) else []
    else:
        names = zip(("pan_rad", "tilt_rad"), wrong, strict=True)
        faults = [f"the sign of {name} is wrong" for name, off in names if off]
    if faults:
        axis = wrong.index(True)
        yield SurveyFinding(
            "error",
            "images.csv",
            f"{' and '.join(faults)}: the boards are spread by {np.degrees(given[axis]):.0f} degrees about "
            f"where the head looks as written, and by {np.degrees(better[axis]):.0f} degrees the other way",
            "Write radians; positive pan turns right, positive tilt looks up",
        )


def _spread_rad(joints_rad: list[FloatArray], boards_rad: list[FloatArray]) -> float:
    """Rms angle between boards and joints (n,) about each camera's mean."""
    off = []
    for turned, seen in zip(joints_rad, boards_rad, strict=True):
        aside = np.exp(1j * (seen - turned))
        middle = aside.mean()
        off.append(np.angle(aside * np.conj(middle / max(abs(middle), 1e-12))))
    return float(np.sqrt(np.mean(np.concatenate(off) ** 2)))
