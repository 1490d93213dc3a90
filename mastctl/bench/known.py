"""The knowledge of a run: all that was seen, the rig that follows from it, and how well it would point.

What is seen goes to the disk first. It is fitted whenever there is half as much more of it.
"""

from __future__ import annotations

import itertools
import math
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace

import numpy as np

from calib.adjust.result import BenchCalibration
from calib.adjust.solver import covariance_of
from calib.errors import CalibError, Unreachable
from calib.geometry.rigid import Rigid
from calib.plan.knowledge import BenchShot, BoardView, ExpectedPointing, Knowledge, Workspace, pointing
from calib.plan.placements import FEWEST, body_cameras
from calib.plan.poses import AttitudeChoice, Sought, expected_px, readings, rover_from_board, with_board
from calib.survey.records import Survey
from calib.survey.writer import BenchFolder
from calib.targets.boards import AnyBoard
from mastctl.answers import MOST_CELLS, BenchProgress, Coverage
from mastctl.bench.mast import BenchHead, BenchLook
from mastctl.bench.survey import fit_in_frame, keep_look, look_name, looks_of
from mastctl.calibration.landing import first_cameras

USUAL_PAN_RAD, USUAL_TILT_RAD = (-1.2, 1.2), (-0.9, 0.3)
"""Where a rig points, as far as the limits let it."""

STILL = 4
"""Pictures of a placement by a camera on the body: it stands still before it, and more only halve noise."""

CORNERS, APART = ((0.05, 0.05), (0.95, 0.95), (0.95, 0.05), (0.05, 0.95)), 0.15
"""Where in the picture of a camera that does not point the board's middle should have been, in parts of width
and height, and how far from there, in parts of the view, it may have been instead."""

FIRST_FIT, MORE = 4, 1.5
"""Looks before the first fit, and how many times as many before the next."""

CELLS = (8, MOST_CELLS // 8)
"""Columns and rows into which an image is divided to count where corners were seen."""

LEAST_PX, LEAST_SCALE = 0.01, 0.1
"""No corner is surer than this, and none so much surer than its finder says; few pictures agree by chance."""


class BenchKnowledge:
    """What was seen, and what follows from it.

    ``folder`` is the survey's, whose looks are known already; ``say`` shows what a fit refuses. Of the
    estimate, ``now`` is the rig with the boards' places, ``sought`` what a shot has to show, ``aim`` and
    ``workspace`` where the rig is to point. ``looks`` are placement, whether it is the check's, and the look,
    in turn; ``shots`` what of them is fitted; ``fitted`` is the last fit, and ``fitted_looks`` how many looks
    it knew.
    """

    def __init__(
        self, head: BenchHead, folder: BenchFolder, board: AnyBoard, say: Callable[[str], None]
    ) -> None:
        self.head, self.board, self.folder = head, board, folder
        self._say, survey = say, folder.survey()
        self._numbers = itertools.count(len(set(map(look_name, survey.images))) + 1)
        self.workspace = Workspace(
            first_cameras(head.rig),
            _within(head.pan_limits_rad, USUAL_PAN_RAD),
            _within(head.tilt_limits_rad, USUAL_TILT_RAD),
            one_sided=head.one_sided,
        )
        every = board.in_board_m(board.ids)
        least = len(every) if board.kind in ("dots", "checkerboard") else max(8, len(every) // 8)
        self.sought = Sought(
            every, survey.sigma.corner_px, least, head.pan_limits_rad, head.tilt_limits_rad, head.one_sided
        )
        # A count is rounded both when the head is sent and when it is read.
        self.now = Knowledge(head.rig, {}, head.count_rad / math.sqrt(12.0))
        self.aim: ExpectedPointing = pointing(self.now, self.workspace)
        self.looks: list[tuple[str, bool, BenchLook]] = list(looks_of(survey))
        self.shots: list[BenchShot] = []
        self.fitted: BenchCalibration | None = None
        self.fitted_looks = 0
        self._tried_looks = 0
        self._scale = 1.0

    @property
    def counts_px(self) -> float:
        """What the head's counts alone leave of a first pointing, rms per axis."""
        return self.aim.by_counts_px(self.now.joint_sigma_rad)

    def predicted_px(self) -> float:
        """Return what the pictures up to now leave of it, on paper."""
        return expected_px(self.now, self.shots, self.aim) if self.shots else math.inf

    def placements(self) -> list[str]:
        """Return the names of the placements, in turn."""
        return list(dict.fromkeys(placement for placement, _, _ in self.looks))

    def of(self, name: str, check: bool | None = None) -> list[BenchLook]:
        """Return the looks of a placement: all, or those that are a check's or are not."""
        return [one for at, is_check, one in self.looks if at == name and check in (None, is_check)]

    def pictures(self) -> int:
        """Return how many pictures the camera with most of them has."""
        counts = Counter(camera for _, _, look in self.looks for camera in look.corners)
        return max(counts.values(), default=0)

    def cameras_for(self, name: str) -> list[str]:
        """Return the cameras whose pictures of a placement may tell something: those of the head, and those
        on the body that have not seen it stand there yet."""
        return [
            camera
            for camera, mounted in self.now.rig.cameras.items()
            if mounted.on == "head" or sum(camera in look.cameras for look in self.of(name)) < STILL
        ]

    def round_others(self, name: str) -> Iterator[BenchShot]:
        """Yield attitudes that bring a placement's board to the image's corners of each head camera that
        does not point, apart from those that were taken: what tells most of pointing need not show the board
        to a narrow view, and that camera's own place in the head follows from such images alone."""
        board = self.now.boards[name].translation_m
        for camera, mounted in self.now.rig.cameras.items():
            if mounted.on != "head" or camera in self.workspace.cameras:
                continue
            size, model = np.array(mounted.model.size_px), mounted.model
            apart = APART * size / (np.linalg.norm(model.H), np.linalg.norm(model.V))
            for place in CORNERS:
                try:
                    at = readings(
                        self.now.rig, self.sought, model, board, (place[0] * size[0], place[1] * size[1])
                    )
                except (Unreachable, CalibError, ValueError):
                    continue
                mine = [look for look in self.of(name) if camera in look.corners]
                if all((np.abs(np.subtract((one.pan_rad, one.tilt_rad), at)) > apart).any() for one in mine):
                    yield BenchShot(name, *at, ())

    def progress(self, target_px: float, choice: AttitudeChoice | None = None) -> BenchProgress:
        """Return how far the run is, with the next attitude if one was chosen."""
        predicted_px = self.predicted_px()
        return {
            "placements": len(self.placements()),
            "pictures": self.pictures(),
            "predicted_px": predicted_px if math.isfinite(predicted_px) else None,
            "target_px": target_px,
            "counts_px": self.counts_px,
            "expected_px": None if choice is None else choice.expected_px,
            "next_rad": None if choice is None else [choice.shot.pan_rad, choice.shot.tilt_rad],
            "cameras": self._coverage(),
        }

    def _coverage(self) -> dict[str, Coverage]:
        """How many corners were seen in each of `CELLS` of each camera's image, row by row."""
        shown: dict[str, Coverage] = {}
        for name, camera in self.now.rig.cameras.items():
            size = camera.model.size_px
            corners = [look.corners.get(name) for _, check, look in self.looks if not check]
            pixels = np.concatenate(
                [np.empty((0, 2)), *(one.pixels_px for one in corners if one is not None)]
            )
            x, y = np.clip(pixels, -0.5, np.subtract(size, 0.5)).T
            edges = [(-0.5, extent - 0.5) for extent in size[::-1]]
            counts, _, _ = np.histogram2d(y, x, bins=CELLS[::-1], range=edges)
            shown[name] = {"size_px": list(size), "cells": counts.astype(int).ravel().tolist()}
        return shown

    def untied(self) -> list[str]:
        """Return the body cameras that have seen too few of the placements that the head saw."""
        on_head = [c for c, camera in self.now.rig.cameras.items() if camera.on == "head"]
        seen = [(name, set(look.corners)) for name, check, look in self.looks if not check]
        by_head = {name for name, cameras in seen if cameras & set(on_head)}
        return [
            body
            for body in body_cameras(self.now)
            if len({name for name, cameras in seen if body in cameras} & by_head) < FEWEST
        ]

    def promised_px(self, looks: Sequence[BenchLook], name: str) -> dict[str, float]:
        """Return what corners of looks that were not fitted should be off by, rms per axis, by camera."""
        squares: dict[str, list[float]] = {}
        covariance = covariance_of(with_board(self.now, self.shots, name))
        for look in looks:
            shot = self._shot(name, look)
            for view in shot.views:
                rates = self.now.view_rates(shot, view)
                by_rig = np.einsum("nip,pq,niq->ni", rates[..., :-2], covariance, rates[..., :-2])
                by_joints = self.now.joint_sigma_rad**2 * (rates[..., -2:] ** 2).sum(axis=2)
                square = float(np.mean(by_rig + by_joints)) + self.sought.sigma_px**2
                squares.setdefault(view.camera, []).append(square)
        return {camera: math.sqrt(np.mean(values)) for camera, values in squares.items()}

    def take(self, name: str, look: BenchLook, check: bool = False) -> None:
        """Keep a look at a placement, add it to what is known, and fit if there is much more of it."""
        keep_look(self.folder, self.head.rig, name, next(self._numbers), look, check)
        self.looks.append((name, check, look))
        if name not in self.now.boards:
            self.now = replace(self.now, boards={**self.now.boards, name: self._board_from(look)})
        if check:
            return
        self.shots.append(self._shot(name, look))
        if len(self.looks) >= max(FIRST_FIT, MORE * self._tried_looks):
            self.try_fit()

    def try_fit(self) -> None:
        """Fit everything that was seen, if that can be; what hinders it is said."""
        try:
            self.fit()
        except CalibError as reason:
            self._say(f"no fit yet: {reason}")

    def fit(self) -> BenchCalibration:
        """Return the fit of everything that was seen; it is the present estimate then.

        Boards that it does not know stay where they were seen. Raises CalibError if it cannot be fitted.
        """
        if self.fitted is not None and self.fitted_looks == len(self.looks):
            return self.fitted
        self._tried_looks, survey, rig = len(self.looks), self.folder.survey(), self.head.rig
        self.fitted = fitted = fit_in_frame(survey, None, rig)
        self.fitted_looks = len(self.looks)
        body = {n: c for n, c in rig.cameras.items() if c.on == "rover"}
        rig = replace(fitted.rig, cameras={**body, **fitted.rig.cameras})
        boards = {placement: pose for (_, placement), pose in fitted.rover_from_board.items()}
        self.now = replace(self.now, rig=rig, boards=boards)
        rms_px, self._scale = corner_noise(fitted, survey)
        self.sought = replace(self.sought, sigma_px=rms_px)
        self.aim = pointing(self.now, self.workspace)
        self.believe_boards()
        return fitted

    def believe_boards(self) -> None:
        """See boards that no fit has placed with the present rig; a placement that a fit left out tells
        nothing."""
        boards = dict(self.now.boards)
        for name, _, look in self.looks:
            if name not in boards:
                boards[name] = self._board_from(look)
        self.now = replace(self.now, boards=boards)
        placed = {name for _, name in self.fitted.rover_from_board} if self.fitted else set(boards)
        self.shots = [
            self._shot(name, look) for name, check, look in self.looks if not check and name in placed
        ]

    def _shot(self, name: str, look: BenchLook) -> BenchShot:
        views = tuple(
            BoardView(camera, self.board.in_board_m(corners.ids), self._scale * corners.sigma_px)
            for camera, corners in look.corners.items()
            if camera in self.now.rig.cameras
        )
        return BenchShot(name, look.pan_rad, look.tilt_rad, views, look.pan_approach, look.tilt_approach)

    def _board_from(self, look: BenchLook) -> Rigid:
        """Where the board is, by the picture that shows most of it."""
        camera, corners = max(look.corners.items(), key=lambda one: len(one[1]))
        sides = look.pan_approach, look.tilt_approach
        true_rad = self.now.rig.joints.true_rad((look.pan_rad, look.tilt_rad), sides)
        in_board_m = self.board.in_board_m(corners.ids)
        return rover_from_board(self.now.rig, camera, *true_rad, in_board_m, corners.pixels_px)


def corner_noise(fit: BenchCalibration, survey: Survey) -> tuple[float, float]:
    """Return the rms of fitted corners, px an axis, and how large it is against the corners' own sigmas."""
    rms_px = float(np.sqrt(np.mean(np.square(list(fit.rms_px.values())))))
    # Corners were fitted with what print and lens add; those that a run plans with come without it.
    fitted_px = np.median(np.concatenate([image.sigma_px for image in fit.images]))
    own_px = np.median(np.concatenate([one.sigma_px for one in survey.corners.values()]))
    scale = float(np.sqrt(fit.chi2 / max(fit.degrees_of_freedom, 1.0)) * fitted_px / own_px)
    return max(rms_px, LEAST_PX), max(scale, LEAST_SCALE)


def _within(limits_rad: tuple[float, float], usual_rad: tuple[float, float]) -> tuple[float, float]:
    """What of the usual range the limits leave; the limits where that is nothing."""
    low, high = max(limits_rad[0], usual_rad[0]), min(limits_rad[1], usual_rad[1])
    return (low, high) if low < high else limits_rad
