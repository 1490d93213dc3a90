"""A run's survey: its folder with all that was seen and a journal, and the fit in the rover frame.

No board of unknown place shows where the rover frame is: the mast stays where the former mast file has it,
unless a level and a tape show another place.
"""

from __future__ import annotations

import fcntl
import json
import os
import weakref
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, cast

import numpy as np

from calib.adjust.result import BenchCalibration
from calib.calibrate.bench import fit_bench
from calib.calibrate.starts.bench import BenchNotFitted, BoardMoved, SomethingChanged
from calib.errors import BadFile
from calib.files import replace_bytes
from calib.files.mast_file import load_rig
from calib.geometry.rig import Mast, Rig
from calib.plan.placements import FEWEST, Placement
from calib.survey.records import Approach, Sigma, Survey, SurveyCamera, SurveyImage
from calib.survey.writer import BenchFolder, NotWritten
from calib.targets.boards import AnyBoard
from mastctl.bench.mast import BenchLook, SeenBoard
from mastctl.json_lines import append_line

JOURNAL = "bench.jsonl"

BOARD = "board"
"""The board's name in a survey."""

FORMER = "former_mast.yaml"
"""The mast file that was in use when the run began."""


class RunFolder:
    """The folder of one run; whatever it was given is on the disk when a call returns.

    A new folder, or that of a run with the same board, sigmas and cameras, which goes on. Once ``let_go`` is
    called another run may go on with it; the end of the process does the same. Raises BadFile if the folder
    holds something else, or another run keeps its looks there.
    """

    def __init__(self, path: Path, board: AnyBoard, sigma: Sigma, rig: Rig) -> None:
        self.path, self.sigma_px = path, sigma.corner_px
        self._cameras = survey_cameras(rig)
        self._folder = BenchFolder(path, {BOARD: board}, sigma, self._cameras, rig.stereo)
        self.let_go = weakref.finalize(self, os.close, _locked(path))
        self._journal = path / JOURNAL
        self.notes = read_notes(path)
        self._numbers: dict[str, int] = {}
        for image in self._folder.survey().images:
            number = _number_of(image, path)
            self._numbers[image.placement] = max(number, self._numbers.get(image.placement, 0))

    def begin(self, former: bytes) -> None:
        """Keep the mast file in use, unless one is kept already."""
        path = self.path / FORMER
        try:
            if not path.exists():
                replace_bytes(path, former, 0o644)
        except OSError as error:
            raise NotWritten(path, "", f"cannot be written: {error.strerror or error}") from None

    def survey(self) -> Survey:
        """Return all that was seen."""
        return self._folder.survey()

    def note(self, **line: Any) -> None:
        """Write a line into the journal."""
        text = json.dumps(line, allow_nan=False)
        try:
            append_line(self._journal, text.encode() + b"\n")
        except OSError as error:
            raise NotWritten(self._journal, "", f"cannot be written: {error.strerror or error}") from None
        self.notes.append(line)

    def add(self, placement: str, look: BenchLook, check: bool) -> None:
        """Keep the pictures of a look that show the board."""
        number = self._numbers.get(placement, 0) + 1
        for one in look.found:
            name = f"{placement}-{number:03d}-{one.camera}"
            on_head = self._cameras[one.camera].on == "head"
            sides = (look.pan_approach, look.tilt_approach) if on_head else (0, 0)
            image = SurveyImage(
                name=name,
                camera=one.camera,
                setup="",
                placement=placement,
                purpose="check" if check else "mast" if on_head else "camera",
                pan_rad=look.pan_rad if on_head else None,
                tilt_rad=look.tilt_rad if on_head else None,
                file=Path("images") / f"{name}.png" if one.data else Path(),
                row=0,
                board=BOARD,
                pan_approach=cast(Approach, sides[0]),
                tilt_approach=cast(Approach, sides[1]),
            )
            self._folder.append(image, one.corners, one.data or None)
        self._numbers[placement] = number

    def requested(self, name: str) -> Placement | None:
        """Return where a placement was requested; None if it was not, or a kill cut it short."""
        for note in self.notes:
            if note.get("event") == "placement" and note.get("name") == name:
                at = note["requested"]
                return Placement(**{**at, "turned_deg": tuple(at["turned_deg"])})
        return None

    def is_over(self, name: str) -> bool:
        """Return whether a placement was ended."""
        return any(note.get("name") == name and note.get("event") == "done" for note in self.notes)


def _locked(path: Path) -> int:
    """A descriptor that keeps every other run out of a folder, until it is closed or the process ends."""
    descriptor = os.open(path, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        os.close(descriptor)
        reason = "another run keeps its looks there; wait for its end, or name another folder (--survey)"
        raise BadFile(path, "", reason) from None
    return descriptor


def former_rig(folder: Path) -> Rig | None:
    """Return the rig as it was known when a folder's run began; None of a folder that no run wrote.

    Raises BadFile if what is kept is no mast file.
    """
    path = folder / FORMER
    return load_rig(path).rig if path.exists() else None


def moved_placements(notes: Iterable[Mapping[str, Any]]) -> dict[str, float]:
    """Return the placements whose first picture, taken again, showed the board aside: by how many pixels."""
    return {str(note["name"]): float(note["apart_px"]) for note in notes if note.get("event") == "moved"}


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


def looks_of(survey: Survey) -> Iterator[tuple[str, bool, BenchLook]]:
    """Yield what a folder shows, look by look: placement, whether it is a check's, the look."""
    groups: dict[str, list[SurveyImage]] = {}
    for image in survey.images:
        if image.name in survey.corners:
            groups.setdefault(_look_name(image), []).append(image)
    for images in groups.values():
        seen = tuple(SeenBoard(i.camera, survey.corners[i.name]) for i in images)
        head = next((i for i in images if i.pan_rad is not None), images[0])
        look = BenchLook(
            seen, head.pan_rad or 0.0, head.tilt_rad or 0.0, head.pan_approach, head.tilt_approach
        )
        yield images[0].placement, images[0].purpose == "check", look


def _look_name(image: SurveyImage) -> str:
    """The name of an image without its camera's."""
    return image.name.removesuffix(f"-{image.camera}")


def _number_of(image: SurveyImage, path: Path) -> int:
    """Which look of its placement an image is of. Raises BadFile for one that no run took."""
    number = _look_name(image).removeprefix(f"{image.placement}-")
    if not (number.isascii() and number.isdigit()):
        reason = (
            f"{image.name} where PLACEMENT-NUMBER-CAMERA is expected: no run took these pictures; "
            "fit them by `mastctl calibrate bench FOLDER`, or begin another run"
        )
        raise BadFile(path / "images.csv", "", reason)
    return int(number)


def read_notes(folder: Path) -> list[dict[str, Any]]:
    """Return the lines of a run's journal; one that a kill cut short is passed over. Raises BadFile."""
    path = folder / JOURNAL
    notes: list[dict[str, Any]] = []
    try:
        lines = path.read_bytes().splitlines()
    except FileNotFoundError:
        return notes
    except OSError as error:
        raise BadFile(path, "", f"cannot be read: {error.strerror or error}") from None
    for line in lines:
        try:
            note = json.loads(line)
        except (ValueError, RecursionError):
            continue
        if isinstance(note, dict):
            notes.append(note)
    return notes


def fit_in_frame(
    survey: Survey,
    mast_at: Sequence[float] | None,
    former: Rig | None,
    moved: Mapping[str, float] | None = None,
) -> BenchCalibration:
    """Fit a bench with the mast at ``mast_at``, else where the ``former`` rig has it.

    ``moved`` as of `moved_placements`: where the fit does not find out what moved when, it does without them.
    Raises BenchNotFitted if the images do not determine a rig.
    """
    place = None if former is None else former.mast.rover_from_mast
    if mast_at is not None:
        place = Mast(np.array(mast_at[:3]), np.array(mast_at[3:])).rover_from_mast

    def fitted(survey: Survey) -> BenchCalibration:
        survey, notes = without_lonely(survey)
        done = fit_bench(survey) if place is None else fit_bench(survey, rover_from_mast=place)
        return replace(done, notes=(*done.notes, *notes))

    try:
        return fitted(survey)
    except SomethingChanged:
        raise
    except BenchNotFitted as reason:
        moved = moved or {}
        spoiled = {*moved, *([reason.placement] if isinstance(reason, BoardMoved) else ())}
        rest = tuple(image for image in survey.images if image.placement not in spoiled)
        if not spoiled or not rest:
            raise
        sentences = [
            f"the board or the head moved during placement {name} (its first picture taken again shows the "
            f"board {apart_px:.1f} px aside): its pictures are left out"
            for name, apart_px in moved.items()
        ]
        sentences.append(f"with the pictures of placement {' and '.join(sorted(spoiled))}, {reason}")
        corners = {i.name: survey.corners[i.name] for i in rest if i.name in survey.corners}
        try:
            done = fitted(replace(survey, images=rest, corners=corners))
        except BenchNotFitted:
            raise BenchNotFitted(f"{'; '.join(sentences)}; what is left without them is too little") from None
        return replace(done, notes=(*done.notes, *sentences))


def without_lonely(survey: Survey) -> tuple[Survey, tuple[str, ...]]:
    """Return the survey without body cameras that nothing ties to the head, and a sentence on each.

    One placement ties none: of it, its focal length and its distance trade for each other.
    """
    head = {name for name, camera in survey.cameras.items() if camera.on == "head"}
    shown = [i for i in survey.images if i.name in survey.corners and i.purpose != "check"]
    by_head = {(i.board, i.placement) for i in shown if i.camera in head}
    lonely = {}
    for name in set(survey.cameras) - head:
        both = len({(i.board, i.placement) for i in shown if i.camera == name} & by_head)
        if both < FEWEST:
            lonely[name] = (
                f"body camera {name} is not tied to the head: it saw the board at "
                f"{both or 'no'} placement{'s' * (both > 1)} that the head saw too, {FEWEST} at least are "
                "expected. Put the board low, where both see it"
            )
    images = tuple(i for i in survey.images if i.camera not in lonely)
    left = replace(
        survey,
        cameras={n: c for n, c in survey.cameras.items() if n not in lonely},
        stereo={n: pair for n, pair in survey.stereo.items() if not set(pair) & set(lonely)},
        images=images,
        corners={i.name: survey.corners[i.name] for i in images if i.name in survey.corners},
    )
    return left if lonely else survey, tuple(lonely[name] for name in sorted(lonely))
