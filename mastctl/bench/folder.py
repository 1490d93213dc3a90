"""A run on disk: the survey's folder with all that was seen, and a journal of what was done."""

from __future__ import annotations

import fcntl
import json
import os
import weakref
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any, cast

from calib.errors import BadFile
from calib.files import replace_bytes
from calib.files.mast_file import load_rig
from calib.geometry.rig import Rig
from calib.plan.placements import Placement
from calib.survey.records import Approach, Sigma, Survey, SurveyCamera, SurveyImage
from calib.survey.writer import BenchFolder, NotWritten
from calib.targets.boards import AnyBoard
from mastctl.bench.frame import RoverFrame, frame_of
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
    called another run may go on with it; the end of the process does the same.

    Raises
    ------
    BadFile
        If the folder holds something else, or another run keeps its looks there.
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

    def begin(self, former: bytes, frame: RoverFrame) -> None:
        """Keep the mast file in use, unless one is kept already, and what the rover frame hangs on."""
        path = self.path / FORMER
        try:
            if not path.exists():
                replace_bytes(path, former, 0o644)
        except OSError as error:
            raise NotWritten(path, "", f"cannot be written: {error.strerror or error}") from None
        if frame.stated and frame != frame_of(self.notes):
            self.note(event="frame", **frame.as_json())

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
                pan_rad=look.pan_rad if on_head else None,  # at rest: one reading for all cameras
                tilt_rad=look.tilt_rad if on_head else None,
                file=Path("images") / f"{name}.png" if one.data else Path(),
                row=0,
                board=BOARD,
                pan_approach=cast(Approach, sides[0]),
                tilt_approach=cast(Approach, sides[1]),
            )
            self._folder.append(image, one.corners, one.data or None)
        self._numbers[placement] = number
        self.note(event="look", placement=placement, number=number, seconds=round(look.seconds, 3))

    def requested(self, name: str) -> Placement | None:
        """Return where a placement was requested; None if it was not, or a kill cut it short."""
        for note in self.notes:
            if note.get("event") == "placement" and note.get("name") == name:
                return Placement(**{**note["asked"], "turned_deg": tuple(note["asked"]["turned_deg"])})
        return None

    def is_over(self, name: str) -> bool:
        """Return whether a placement was ended."""
        return any(
            note.get("name") == name and note.get("event") in ("closed", "done") for note in self.notes
        )

    def moved(self) -> dict[str, float]:
        """Return the placements whose first picture, taken again, showed the board aside: by how many px."""
        return moved_placements(self.notes)

    def seconds(self) -> float:
        """Return how long all looks took, seconds of the rover's clock."""
        return sum(float(note.get("seconds", 0.0)) for note in self.notes)


def _locked(path: Path) -> int:
    """A descriptor that keeps every other run out of a folder, until it is closed or the process ends."""
    descriptor = os.open(path, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        os.close(descriptor)
        words = "another run keeps its looks there; wait for its end, or name another folder (--survey)"
        raise BadFile(path, "", words) from None
    return descriptor


def former_rig(folder: Path) -> Rig | None:
    """Return the rig as it was known when a folder's run began; None of a folder that no run wrote.

    Raises
    ------
    BadFile
        If what is kept is no mast file.
    """
    path = folder / FORMER
    return load_rig(path).rig if path.exists() else None


def moved_placements(notes: Iterable[Mapping[str, Any]]) -> dict[str, float]:
    """Return what a journal says of placements that moved: by how many pixels."""
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
        groups.setdefault(_of_look(image), []).append(image)
    for images in groups.values():
        seen = tuple(
            SeenBoard(
                i.camera, i.pan_rad or 0.0, i.tilt_rad or 0.0, survey.corners.get(i.name), "no corners kept"
            )
            for i in images
            if i.name in survey.corners
        )
        if seen:
            head = next((i for i in images if i.pan_rad is not None), images[0])
            look = BenchLook(seen, head.pan_approach, head.tilt_approach, 0.0)
            yield images[0].placement, images[0].purpose == "check", look


def _of_look(image: SurveyImage) -> str:
    """The name of an image without its camera's."""
    return image.name.removesuffix(f"-{image.camera}")


def _number_of(image: SurveyImage, path: Path) -> int:
    """Which look of its placement an image is of. Raises BadFile for one that no run took."""
    number = _of_look(image).removeprefix(f"{image.placement}-")
    if not (number.isascii() and number.isdigit()):
        words = (
            f"{image.name} where PLACEMENT-NUMBER-CAMERA is expected: no run took these pictures; "
            "fit them by `mastctl calibrate bench FOLDER`, or name another folder for a run (--survey)"
        )
        raise BadFile(path / "images.csv", "", words)
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
