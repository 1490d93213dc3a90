"""What people keep by a name on the daemon's disk: places of the head, and targets, which images show."""

from __future__ import annotations

import contextlib
import threading
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from calib.errors import BadFile
from calib.files.records import read_value
from calib.geometry.rigid import FloatArray, Rigid
from mastctl.answers import HeadPlace, KeptTarget
from mastctl.control.operations import OperationRunner
from mastctl.devices.frames import StampedFrame
from mastctl.errors import BadRequest, NotKnown, NotNow, Unable
from mastctl.motion.pairs import in_picture
from mastctl.motion.track import ACTIVE, Tracker
from mastctl.safety.state_folder import StateFile
from mastctl.service.masts import Masts

HOME = "home"
MOST = 50
AT_HOME: HeadPlace = {"pan_rad": 0.0, "tilt_rad": 0.0}
"""Home, until another one is kept."""


class KeptByName:
    """Records by name in one file; safe to use from any thread.

    ``plural`` (``places``) is the name of the file, of its schema and of its one key; ``kind`` the TypedDict
    of a record; ``always`` what is there until others of these names are kept. Each call reads the disk:
    there are few, and what was kept by hand is found too. ``known``: as read last; replaced, never edited.
    """

    def __init__(self, folder: Path, plural: str, kind: Any, always: Mapping[str, Any] | None = None) -> None:
        self._file = StateFile(folder / f"{plural}.json", f"mastctl/{plural}/1")
        self._plural, self._kind, self._always = plural, dict[str, kind], dict(always or {})
        self._writing = threading.Lock()
        self.known: Mapping[str, Any] = {}
        with contextlib.suppress(Unable):
            self._read()

    def all(self) -> dict[str, Any]:
        """Return every record by its name, what is always there first. Raises Unable ``unreadable``."""
        return self._always | dict(sorted(self._read().items()))

    def keep(self, name: str, one: Mapping[str, Any]) -> dict[str, Any]:
        """Keep a record by a name, in the place of a former one, and return all.

        Raises BadRequest ``too_many_places``, ``too_many_targets``; Unable ``unreadable``, ``not_saved``.
        """
        with self._writing:
            kept = self._read()
            if name not in kept and len(kept) >= MOST:
                message = f"{MOST} {self._plural} are kept already; forget one of them first"
                raise BadRequest(f"too_many_{self._plural}", message)
            return self._write(kept | {name: dict(one)})

    def forget(self, name: str) -> dict[str, Any]:
        """Forget a record and return all that are left.

        Raises NotKnown ``place_unknown``, ``target_unknown``; Unable ``unreadable``, ``not_saved``.
        """
        with self._writing:
            kept = self._read()
            if kept.pop(name, None) is None:
                one = self._plural.removesuffix("s")
                raise NotKnown(f"{one}_unknown", f"no {one} is kept by the name {name!r}")
            return self._write(kept)

    def _read(self) -> dict[str, Any]:
        try:
            kept = (self._file.read() or {}).get(self._plural, {})
            self.known = read_value(self._kind, kept, self._file.path, self._plural)
        except BadFile as error:
            raise Unable("unreadable", str(error)) from None
        return dict(self.known)

    def _write(self, records: dict[str, Any]) -> dict[str, Any]:
        try:
            self._file.write({self._plural: records})
        except BadFile as error:
            raise Unable("not_saved", str(error)) from None
        return self.all()


def places(folder: Path) -> KeptByName:
    """Return the places of the head; home is 0, 0 until it is kept as something else."""
    return KeptByName(folder, "places", HeadPlace, {HOME: AT_HOME})


class Targets(KeptByName):
    """The kept targets: in the site frame, if a pose was known when they were kept."""

    def __init__(self, folder: Path, masts: Masts, tracker: Tracker, operations: OperationRunner) -> None:
        super().__init__(folder, "targets", KeptTarget)
        self._masts = masts
        self._tracker = tracker
        self._operations = operations

    def keep_measured(self, name: str, body: Any) -> dict[str, KeptTarget]:
        """Keep a position, or the one that an operation measured, by a name, and return all.

        Raises NotKnown, NotNow if the operation measured no position, or the rover moved since; as `keep`.
        """
        position_m, frame, covariance_m2 = body.position_m, body.frame, body.covariance_m2
        if body.operation is not None:
            record, moved_s = self._operations.get(body.operation).as_json(), self._tracker.moved_s
            position_m, frame = record["position_m"], "rover"
            if position_m is None or (moved_s is not None and moved_s > record["created_s"]):
                why = "measured no position" if position_m is None else "was before the rover moved"
                raise NotNow("no_position", f"operation {body.operation} {why}; another pointing is expected")
            measured = [one["detail"] for one in record["steps"] if one["name"] == "triangulate"]
            covariance_m2 = measured[-1].get("covariance_m2") if measured else None
        if frame == "rover" and self._tracker.pose is not None:
            site_from_rover = self._tracker.pose.site_from_rover
            frame, (position_m, covariance_m2) = "site", _carried(site_from_rover, position_m, covariance_m2)
        return self.keep(name, {"position_m": position_m, "frame": frame, "covariance_m2": covariance_m2})

    def in_rover(self) -> Iterator[tuple[str, FloatArray, Any]]:
        """Yield name, position, covariance in the rover frame of now."""
        pose = self._tracker.pose
        for name, one in self.known.items():
            position_m, covariance_m2 = one["position_m"], one["covariance_m2"]
            if one["frame"] == "site" and pose is not None:
                rover_from_site = pose.site_from_rover.inverse
                position_m, covariance_m2 = _carried(rover_from_site, position_m, covariance_m2)
            yield name, np.array(position_m), covariance_m2

    def shown_in(self, frame: StampedFrame) -> dict[str, dict[str, float]]:
        """Return where a frame shows the kept targets, by name, as `track_in` has one."""
        shown = {name: self._shown(frame, at, covariance) for name, at, covariance in self.in_rover()}
        return {name: place for name, place in shown.items() if place is not None}

    def track_in(self, frame: StampedFrame) -> dict[str, float] | None:
        """Return where a frame should show the track's target, pixels, with one sigma as an ellipse.

        None without a target, or where the frame does not show it. The ellipse has half axes ``major_px`` and
        ``minor_px``, the first turned by ``turn_rad`` from x towards y.
        """
        status = self._tracker.status
        if status.state not in ACTIVE or status.position_m is None:
            return None
        return self._shown(frame, status.position_m, status.covariance_m2)

    def _shown(self, frame: StampedFrame, position_m: FloatArray, covariance: Any) -> dict[str, float] | None:
        stored = self._masts.in_use.stored
        if frame.mast_digest != stored.digest:
            return None
        camera = stored.rig.camera_in_rover(frame.camera, *frame.true_rad)
        return in_picture(camera, position_m, covariance)


def _carried(motion: Rigid, position_m: Any, covariance_m2: Any) -> tuple[list[float], Any]:
    """A position and its covariance in another frame."""
    turn = motion.rotation
    turned = None if covariance_m2 is None else (turn @ np.array(covariance_m2) @ turn.T).tolist()
    return motion.points(np.array(position_m)).tolist(), turned
