"""Where the rover frame of a bench is, and the fit in it: no board of unknown place tells it."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from calib.adjust.result import BenchCalibration
from calib.calibrate.bench import fit_bench
from calib.calibrate.starts.bench import BenchNotFitted, SomethingChanged
from calib.geometry.rig import Mast, Rig
from calib.geometry.rigid import Rigid
from calib.plan.placements import FEWEST
from calib.survey.records import Survey
from mastctl.as_json import as_json
from mastctl.calibration.differences import implied_motion
from mastctl.errors import MastctlError

UPRIGHT = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
"""rover_from_board of a board that stands upright and shows its face to the rover: its x is the rover's y."""


class NoSuchFrame(MastctlError):
    """The object that should define the rover frame is missing."""

    code = "no_such_frame"
    exit_code = 2


@dataclass(frozen=True)
class RoverFrame:
    """What fixes the rover frame: one of these, or where the former mast file has the mast.

    ``mast_at``: the mast at zero angles, by a level and a tape: x, y, z, metres, and three angles, radians,
    as in a mast file. ``board_at``: the board of the first placement: x, y, z of its middle, metres, and yaw,
    pitch, roll, degrees, about the rover's z, y, x; 0 0 0: upright, its face to the rover. ``body``: body
    cameras stay where the former mast file has them.
    """

    mast_at: Sequence[float] | None = None
    board_at: Sequence[float] | None = None
    body: bool = False

    def as_json(self) -> dict[str, Any]:
        """Return what is stated."""
        numbers = {"mast_at": self.mast_at, "board_at": self.board_at, "body": self.body or None}
        return {key: as_json(value) for key, value in numbers.items() if value is not None}

    @property
    def stated(self) -> bool:
        """Whether anything is."""
        return self.mast_at is not None or self.board_at is not None or self.body


def frame_of(notes: Sequence[Mapping[str, Any]]) -> RoverFrame:
    """Return what fixes the frame by a run's journal."""
    note: Mapping[str, Any] = next((note for note in reversed(notes) if note.get("event") == "frame"), {})
    return RoverFrame(note.get("mast_at"), note.get("board_at"), bool(note.get("body")))


def rover_from_board(board_at: Sequence[float]) -> Rigid:
    """Return the pose of a board that is stated in metres and degrees (see `RoverFrame`)."""
    turn = Rotation.from_euler("ZYX", board_at[3:], degrees=True).as_matrix()
    return Rigid(turn @ UPRIGHT, np.array(board_at[:3]))


def fit_in_frame(
    survey: Survey,
    frame: RoverFrame,
    former: Rig | None,
    moved: Mapping[str, float] | None = None,
) -> BenchCalibration:
    """Fit a bench in the rover frame that was stated; ``former`` is the rig as it was known before.

    ``moved``: placements at whose end the first image was taken again and showed the board aside, by so many
    pixels. Where the fit does not find out what moved when, it does without them.

    Raises
    ------
    NoSuchFrame
        If the frame hangs on something that is missing.
    BenchNotFitted
        If the images do not determine a rig.
    """
    try:
        return _fit_in_frame(survey, frame, former)
    except SomethingChanged:
        raise
    except BenchNotFitted as reason:
        rest = tuple(image for image in survey.images if image.placement not in (moved or {}))
        if not moved or not rest:
            raise
        sentences = [
            f"the board or the head moved during placement {name} (its first picture taken again shows the "
            f"board {apart_px:.1f} px aside): its pictures are left out"
            for name, apart_px in moved.items()
        ]
        corners = {i.name: survey.corners[i.name] for i in rest if i.name in survey.corners}
        try:
            done = _fit_in_frame(replace(survey, images=rest, corners=corners), frame, former)
        except BenchNotFitted:
            raise BenchNotFitted(
                f"{'; '.join(sentences)}, and what is left is too little: {reason}"
            ) from None
        return replace(done, notes=(*done.notes, *sentences, f"with these, {reason}"))


def _fit_in_frame(survey: Survey, frame: RoverFrame, former: Rig | None) -> BenchCalibration:
    """The fit of what a survey shows."""
    survey, notes = without_lonely(survey)
    stated: dict[str, Any] = {}
    if frame.mast_at is not None:
        place = Mast(np.array(frame.mast_at[:3]), np.array(frame.mast_at[3:])).rover_from_mast
        stated = {"rover_from_mast": place}
    elif frame.board_at is not None:
        first = next((i for i in survey.images if i.name in survey.corners), None)
        if first is None:
            raise BenchNotFitted("no picture shows a board, and the rover frame should hang on the first")
        known = (first.board, first.placement), rover_from_board(frame.board_at)
        stated = {"rover_from_board": known}
    elif former is not None:
        stated = {"rover_from_mast": former.mast.rover_from_mast}
    done = fit_bench(survey, **stated)
    if frame.body:
        place, words = _by_body(done, former)
        done = fit_bench(survey, rover_from_mast=place)
        notes = (*notes, words)
    return replace(done, notes=(*done.notes, *notes))


def _by_body(done: BenchCalibration, former: Rig | None) -> tuple[Rigid, str]:
    """Where the mast stands if the body cameras stay where they were, and that in words."""
    here = done.rig
    if former is None:
        raise NoSuchFrame("the folder holds no former mast file, and so no place of its body cameras")
    names = [
        name
        for name, camera in here.cameras.items()
        if camera.on == "rover" and name in former.cameras and former.cameras[name].on == "rover"
    ]
    if not names:
        raise NoSuchFrame(
            "no body camera is tied to the head, and so none shows where the rover frame is. Have the board "
            "placed where one sees it, or say where the mast is (--mast-at)"
        )
    pairs = [(here.cameras[name].model, former.cameras[name].model) for name in names]
    motion, rms_px = implied_motion(pairs)
    words = (
        f"the rover frame is where the former mast file has {' and '.join(names)}, which see "
        f"{rms_px:.2f} px rms beside that"
    )
    return motion.inverse @ here.mast.rover_from_mast, words


def without_lonely(survey: Survey) -> tuple[Survey, tuple[str, ...]]:
    """Return the survey without body cameras that nothing ties to the head, and a sentence on each.

    One placement ties none: of it, its focal length and its distance trade for each other.
    """
    head = {name for name, camera in survey.cameras.items() if camera.on == "head"}
    shown = [i for i in survey.images if i.name in survey.corners and i.purpose != "check"]
    by_head = {(i.board, i.placement) for i in shown if i.camera in head}
    lonely, notes = set(), []
    for name in survey.cameras:
        if name in head:
            continue
        both = {(i.board, i.placement) for i in shown if i.camera == name} & by_head
        if len(both) < FEWEST:
            lonely.add(name)
            count = "no placement" if not both else "1 placement"
            notes.append(
                f"body camera {name} is not tied to the head: it saw the board at {count} that the head saw "
                f"too, {FEWEST} at least are expected. Put the board low, where both see it"
            )
    if not lonely:
        return survey, ()
    return (
        replace(
            survey,
            cameras={n: c for n, c in survey.cameras.items() if n not in lonely},
            stereo={n: pair for n, pair in survey.stereo.items() if not set(pair) & lonely},
            images=tuple(i for i in survey.images if i.camera not in lonely),
            corners={
                i.name: survey.corners[i.name]
                for i in survey.images
                if i.name in survey.corners and i.camera not in lonely
            },
        ),
        tuple(notes),
    )


LEAST_PX, LEAST_SCALE = 0.01, 0.1
"""No corner is surer than this, and none so much surer than its finder says; few pictures agree by chance."""


@dataclass(frozen=True, eq=False)
class FittedBench:
    """A survey's fit, with all that it says in ``calibration``; None of a stand-in.

    ``boards``: placement to rover_from_board. ``corner_rms_px``: of the fitted corners, per axis.
    ``sigma_scale``: how large residuals are against the sigmas that corners came with.
    """

    rig: Rig
    boards: Mapping[str, Rigid]
    corner_rms_px: float
    sigma_scale: float
    calibration: BenchCalibration | None


FitSurvey = Callable[[Survey], FittedBench]


def fit_in_rover(frame: RoverFrame, former: Rig, moved: Callable[[], Mapping[str, float]]) -> FitSurvey:
    """Return the fit of a bench in a rover frame that was stated; ``moved`` as of `fit_in_frame`."""

    def fit(survey: Survey) -> FittedBench:
        done = fit_in_frame(survey, frame, former, moved=moved())
        boards = {placement: pose for (_, placement), pose in done.rover_from_board.items()}
        rms = float(np.sqrt(np.mean(np.square(list(done.rms_px.values())))))
        # Corners were fitted with what print and lens add; those that a run plans with come without it.
        fitted_px = np.median(np.concatenate([image.sigma_px for image in done.images]))
        own_px = np.median(np.concatenate([one.sigma_px for one in survey.corners.values()]))
        scale = float(np.sqrt(done.chi2 / max(done.degrees_of_freedom, 1.0)) * fitted_px / own_px)
        return FittedBench(done.rig, boards, max(rms, LEAST_PX), max(scale, LEAST_SCALE), done)

    return fit
