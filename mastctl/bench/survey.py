"""A run's survey: the pictures of its looks, and the fit in the rover frame.

No board of unknown place shows where the rover frame is: the mast stays where the former mast file has it,
unless a level and a tape show another place.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, cast

import numpy as np

from calib.adjust.result import BenchCalibration
from calib.calibrate.bench import fit_bench
from calib.calibrate.starts.bench import BenchNotFitted, BoardMoved
from calib.files import replace_bytes
from calib.files.mast_file import load_rig
from calib.geometry.rig import Mast, Rig
from calib.plan.placements import FEWEST
from calib.survey.records import Sigma, Survey, SurveyCamera, SurveyImage
from calib.survey.writer import BenchFolder, NotWritten
from calib.targets.boards import AnyBoard
from mastctl.bench.mast import BenchHead, BenchLook, SeenBoard

BOARD = "board"
"""The board's name in a survey."""

FORMER = "former_mast.yaml"
"""The mast file that was in use when the run began."""

CORNER_PX = 0.1
"""What a corner's sigma is said to be beforehand."""


def open_survey(
    path: Path, board: AnyBoard, head: BenchHead, corner_px: float = CORNER_PX, mast_file: bytes = b""
) -> BenchFolder:
    """Return the folder of a new run, or of one with the same board, sigmas and cameras, which goes on.

    A new one keeps the ``mast_file`` in use. Raises BadFile if the folder holds something else.
    """
    sigma = Sigma(0.0, 0.0, joint_rad=head.count_rad / 12**0.5, corner_px=corner_px)
    folder = BenchFolder(path, {BOARD: board}, sigma, survey_cameras(head.rig), head.rig.stereo)
    former = path / FORMER
    try:
        if mast_file and not former.exists():
            replace_bytes(former, mast_file, 0o644)
    except OSError as error:
        raise NotWritten(former, "", f"cannot be written: {error.strerror or error}") from None
    return folder


def former_rig(folder: Path) -> Rig | None:
    """Return the rig as it was known when a folder's run began; None of a folder that no run wrote.

    Raises BadFile if what is kept is no mast file.
    """
    path = folder / FORMER
    return load_rig(path).rig if path.exists() else None


def survey_cameras(rig: Rig) -> dict[str, SurveyCamera]:
    """Return what a survey says of a rig's cameras beforehand."""
    cameras = {}
    for name, camera in rig.cameras.items():
        model = camera.model
        kind = cast(Any, "CAHVOR" if model.kind == "CAHV" else model.kind)
        focal_px = round(model.focal_px[0], 1)
        cameras[name] = SurveyCamera(
            name, camera.on, model.size_px, kind, focal_px, sensor_mode=camera.sensor_mode
        )
    return cameras


def keep_look(
    folder: BenchFolder, rig: Rig, placement: str, number: int, look: BenchLook, check: bool
) -> None:
    """Keep the pictures of a look that show the board; no other look of the folder has this ``number``."""
    for one in look.found:
        name = f"{placement}-{number:03d}-{one.camera}"
        file = Path("images") / f"{name}.png" if one.data else Path()
        purpose: Any = "check" if check else "camera"
        image = SurveyImage(name, one.camera, "", placement, purpose, None, None, file, 0, board=BOARD)
        if rig.cameras[one.camera].on == "head":
            image = replace(
                image,
                purpose="check" if check else "mast",
                pan_rad=look.pan_rad,
                tilt_rad=look.tilt_rad,
                pan_approach=cast(Any, look.pan_approach),
                tilt_approach=cast(Any, look.tilt_approach),
            )
        folder.append(image, one.corners, one.data or None)


def look_name(image: SurveyImage) -> str:
    """Return the name of an image without its camera's."""
    return image.name.removesuffix(f"-{image.camera}")


def looks_of(survey: Survey) -> Iterator[tuple[str, bool, BenchLook]]:
    """Yield what a folder shows, look by look: placement, whether it is a check's, the look."""
    groups: dict[str, list[SurveyImage]] = {}
    for image in survey.images:
        if image.name in survey.corners:
            groups.setdefault(look_name(image), []).append(image)
    for images in groups.values():
        seen = tuple(SeenBoard(i.camera, survey.corners[i.name]) for i in images)
        head = next((i for i in images if i.pan_rad is not None), images[0])
        look = BenchLook(
            seen, head.pan_rad or 0.0, head.tilt_rad or 0.0, head.pan_approach, head.tilt_approach
        )
        yield images[0].placement, images[0].purpose == "check", look


def fit_in_frame(survey: Survey, mast_at: Sequence[float] | None, former: Rig | None) -> BenchCalibration:
    """Fit a bench with the mast at ``mast_at``, else where the ``former`` rig has it.

    A placement during which the board moved is left out. Raises BenchNotFitted if the images do not determine
    a rig.
    """
    place = None if former is None else former.mast.rover_from_mast
    if mast_at is not None:
        place = Mast(np.array(mast_at[:3]), np.array(mast_at[3:])).rover_from_mast
    tied, notes = without_lonely(survey)
    try:
        fit = fit_bench(tied, rover_from_mast=place)
    except BoardMoved as reason:
        rest = tuple(image for image in survey.images if image.placement != reason.placement)
        if not rest:
            raise
        sentence = f"with the pictures of placement {reason.placement}, {reason}"
        try:
            fit = fit_in_frame(_of_images(survey, rest), mast_at, former)
        except BenchNotFitted:
            raise BenchNotFitted(f"{sentence}; what is left without them is too little") from None
        notes = (sentence,)
    return replace(fit, notes=(*fit.notes, *notes))


def without_lonely(survey: Survey) -> tuple[Survey, tuple[str, ...]]:
    """Return the survey without body cameras that nothing ties to the head, and a sentence on each.

    One placement ties none: of it, its focal length and its distance trade for each other.
    """
    head = {name for name, camera in survey.cameras.items() if camera.on == "head"}
    shown = [i for i in survey.images if i.name in survey.corners and i.purpose != "check"]
    by_head = {(i.board, i.placement) for i in shown if i.camera in head}
    lonely = {}
    for name in sorted(set(survey.cameras) - head):
        both = len({(i.board, i.placement) for i in shown if i.camera == name} & by_head)
        if both < FEWEST:
            lonely[name] = (
                f"body camera {name} is not tied to the head: it saw the board at "
                f"{both or 'no'} placement{'s' * (both > 1)} that the head saw too, {FEWEST} at least are "
                "expected. Put the board low, where both see it"
            )
    if not lonely:
        return survey, ()
    left = replace(
        survey,
        cameras={n: c for n, c in survey.cameras.items() if n not in lonely},
        stereo={n: pair for n, pair in survey.stereo.items() if not set(pair) & set(lonely)},
    )
    return _of_images(left, tuple(i for i in survey.images if i.camera not in lonely)), tuple(lonely.values())


def _of_images(survey: Survey, images: tuple[SurveyImage, ...]) -> Survey:
    corners = {i.name: survey.corners[i.name] for i in images if i.name in survey.corners}
    return replace(survey, images=images, corners=corners)
