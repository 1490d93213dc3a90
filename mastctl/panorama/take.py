"""Taking a panorama: the grid of views, and the operation that takes one after the other."""

from __future__ import annotations

import math
from collections.abc import Callable
from contextlib import ExitStack, suppress
from typing import Any

import numpy as np

from calib.errors import BadFile, CalibError
from calib.geometry.mosaic import BORDER_STEPS, border
from calib.geometry.rig import Rig
from drivers.errors import DriverError
from mastctl.as_json import as_json
from mastctl.devices.devices import Devices
from mastctl.devices.judge import OutsideLimits
from mastctl.devices.keep_out import KeptOut, Pair
from mastctl.errors import BadRequest, MastctlError
from mastctl.motion.steps import Steps
from mastctl.panorama.compose import Composition, compose
from mastctl.panorama.folder import Folder, ViewRecord

MOST_VIEWS = 400
STEEP_RAD = 0.8
"""A view that is steeper may hold the pole; how much of the elevations it covers is measured less steeply."""
LEAST_WIDTH_RAD = 0.01
PAUSE_S = 1e-3
TRIES = 2
IN_A_ROW = 3
"""So many views in a row that fail are no longer the views' fault."""


def grid_of(rig: Rig, camera: str, pan_rad: Pair, tilt_rad: Pair, overlap: float) -> list[Pair]:
    """Return true (pan, tilt) of views that cover a field, row by row, there and back.

    ``pan_rad``, ``tilt_rad``: the field's azimuth and elevation, from and to, about the mast's pan axis.
    A view covers the rectangle inside the image of the camera's true lens; neighbours share ``overlap`` of
    it. Raises BadRequest ``too_many_views``.
    """
    low, high = sorted(tilt_rad)
    middle = max(-STEEP_RAD, min(STEEP_RAD, (low + high) / 2.0))
    _, _, bottom, top = _covered(rig, camera, middle)
    tilts = _spread(low - (bottom - middle), high - (top - middle), top - bottom, overlap)
    views: list[Pair] = []
    for row, tilt in enumerate(max(low, min(high, one)) for one in reversed(tilts)):
        left, right, _, _ = _covered(rig, camera, tilt)
        pans = _spread(min(pan_rad) - left, max(pan_rad) - right, right - left, overlap)
        views += [(pan, tilt) for pan in (reversed(pans) if row % 2 else pans)]
    if len(views) > MOST_VIEWS:
        raise BadRequest("too_many_views", f"{len(views)} views where at most {MOST_VIEWS} are taken")
    return views


def _spread(first: float, last: float, width: float, overlap: float) -> list[float]:
    """Even steps from the first to the last centre of fields of a width; one in the middle if that does."""
    if last <= first:
        return [(first + last) / 2.0]
    count = math.ceil((last - first) / (max(width, LEAST_WIDTH_RAD) * (1.0 - overlap)) - 1e-9) + 1
    return [float(one) for one in np.linspace(first, last, count)]


def _covered(rig: Rig, camera: str, tilt_rad: float) -> tuple[float, float, float, float]:
    """Azimuths and elevations (left, right, bottom, top) that an image holds whole at pan 0 and a tilt."""
    mast_from_head = rig.mast.rover_from_mast.inverse @ rig.mast.rover_from_head(0.0, tilt_rad)
    model = rig.cameras[camera].model.moved(mast_from_head)
    rays = model.ray(border(model)).directions
    azimuth = np.arctan2(rays[:, 1], rays[:, 0]).reshape(4, BORDER_STEPS)
    elevation = -np.arcsin(np.clip(rays[:, 2], -1.0, 1.0)).reshape(4, BORDER_STEPS)
    top, right, bottom, left = range(4)  # the sides of `border`
    return (
        float(azimuth[left].max()), float(azimuth[right].min()),
        float(elevation[bottom].max()), float(elevation[top].min()),
    )  # fmt: skip


class PanoramaTaker(Steps):
    """Takes the views of a panorama that it lacks. Parameters of `Steps`."""

    _fixed = False

    def take(self, folder: Folder, devices: Devices) -> dict[str, Any]:
        """Take, keep and compose; return id and counts. The folder has all that was taken, whatever happens.

        Raises PointingError ``stopped``, the error of three views in a row, BadFile if the disk refuses.
        """
        failed = 0
        try:
            folder.save(folder.index.model_copy(update={"state": "running", "reason": ""}))
            self._check_pictures(folder)
            wanted = [at for at, view in enumerate(folder.index.views) if view.state != "taken"]
            with ExitStack() as fixed:
                for number in wanted:
                    ended = self._view(folder, number, fixed.enter_context, devices)
                    failed = failed + 1 if isinstance(ended, Exception) else 0
                    if failed == IN_A_ROW and isinstance(ended, Exception):
                        raise ended
            with self.step("compose") as detail:
                compose(folder, Composition(), self._pause)
                whole, slip = folder.index.whole, folder.index.slip
                detail.update(seams=None if whole is None else as_json(whole))
                detail.update(slip=None if slip is None else slip.sentence)
        except BaseException as error:
            end = {"state": "ended", "reason": " ".join(str(error).split()) or type(error).__name__}
            with suppress(BadFile):  # of a full disk; the error says so already
                folder.save(folder.index.model_copy(update=end))
            raise
        folder.save(folder.index.model_copy(update={"state": "done"}))
        states = [view.state for view in folder.index.views]
        counts = {state: states.count(state) for state in sorted(set(states))}
        return {"panorama": folder.index.id, "views": counts}

    def _view(
        self, folder: Folder, number: int, fix: Callable[[Any], Any], devices: Devices
    ) -> Exception | None:
        """Take one view, twice if need be, and keep its record; return what it failed with."""
        view = folder.index.views[number]
        error: Exception | None = None
        for _ in range(TRIES):
            try:
                taken = self._taken(folder, number, view, fix, devices)
            except (OutsideLimits, KeptOut) as forbidden:
                reason = " ".join(str(forbidden).split())
                folder.save(folder.index.with_view(number, _with(view, "forbidden", reason)))
                return None
            except (MastctlError, DriverError, CalibError) as failure:
                self.check_not_stopped()
                if isinstance(failure, BadFile) or getattr(failure, "code", "") == "stopped":
                    raise
                error = failure
            else:
                folder.save(folder.index.with_view(number, taken))
                return None
        reason = " ".join(str(error).split())
        folder.save(folder.index.with_view(number, _with(view, "missing", reason)))
        return error

    def _taken(
        self, folder: Folder, number: int, view: ViewRecord, fix: Callable[[Any], Any], devices: Devices
    ) -> ViewRecord:
        """Go to a view, take its pictures at rest, and write them."""
        cameras = folder.index.cameras
        with self.whole("view") as detail:
            detail.update(view=number, of=len(folder.index.views))
            self.before(cameras, (view.pan_rad, view.tilt_rad))
            _, settled = self.go_to_true(view.pan_rad, view.tilt_rad)
            views = self.capture(cameras, settled)
            if folder.index.exposure == "first" and not self._fixed:
                self._fixed = True  # from what the automatic made of the first view
                fix(devices.exposure_fixed())
                views = self.capture(cameras, self.rest())
            frames = {name: folder.keep(number, name, one.frame) for name, one in views.items()}
        evidence = {name: dict(one) for name, one in self.motion_evidence.items()}
        return view.model_copy(
            update={"state": "taken", "reason": "", "frames": frames, "motion_evidence": evidence}
        )

    def _pause(self) -> None:
        """Let a simulated clock go on, by which a stop is confirmed, and end if there was one."""
        self._clock.sleep(PAUSE_S)
        self.check_not_stopped()

    @staticmethod
    def _check_pictures(folder: Folder) -> None:
        """Have views taken again of which a picture is damaged."""
        for number, view in folder.index.taken():
            try:
                for frame in view.frames.values():
                    folder.picture(frame)
            except BadFile as error:
                folder.save(folder.index.with_view(number, _with(view, "missing", str(error))))


def _with(view: ViewRecord, state: str, reason: str) -> ViewRecord:
    return view.model_copy(update={"state": state, "reason": reason})
