"""The panoramas of a daemon: begun, gone on with, listed, clicked, and deleted."""

from __future__ import annotations

import math
import secrets
import shutil
import threading
from collections.abc import Callable, Mapping
from contextlib import AbstractContextManager
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Protocol

from calib.errors import BadFile, CalibError
from calib.files import is_plain_file
from calib.files.mast_file import StoredRig
from calib.geometry.rig import Rig
from drivers.clock import Clock
from mastctl.answers import PanoramaList, PanoramaListed
from mastctl.control.operations import Operation, OperationRunner
from mastctl.devices.devices import Devices
from mastctl.devices.frames import StampedFrame, check_known
from mastctl.errors import BadRequest, NotKnown, NotNow, Unable
from mastctl.motion.requests import PanoramaTarget, PixelTarget, PointRequest
from mastctl.panorama.compose import Seen, picture_at, so_far
from mastctl.panorama.folder import INDEX, SCHEMA, Folder, Index, ViewRecord
from mastctl.panorama.take import PanoramaTaker, grid_of

FOLDER = "panoramas"
HOLDER = "panoramas"
KEPT = 8  # frames of panoramas that were clicked last stay at hand
MOST = 100
"""So many panoramas are kept; the next is refused until one is deleted."""


class MastLike(Protocol):
    """A mast file in use: as it was read, and its bytes."""

    @property
    def stored(self) -> StoredRig: ...
    @property
    def data(self) -> bytes: ...


class Panoramas:
    """Folders of panoramas below a daemon's state folder; safe to use from any thread.

    ``unchanged``: gives the mast file in use, and lets no other come into use inside the block; ``rig``:
    returns its part that is configured.
    """

    def __init__(
        self,
        folder: Path,
        unchanged: Callable[[], AbstractContextManager[MastLike]],
        rig: Callable[[], Rig],
        devices: Devices,
        clock: Clock,
        operations: OperationRunner,
    ) -> None:
        self._folder = folder / FOLDER
        self._unchanged, self._rig, self._devices = unchanged, rig, devices
        self._clock, self._operations = clock, operations
        self._so_far: tuple[str, int, bytes] | None = None
        self._newest: Index | None = None
        self._begun_s: dict[str, float] = {}
        self._known: dict[str, tuple[int, Folder]] = {}  # as read last, with the time of the index

    def begin(self, body: Any, recorded: Mapping[str, Any]) -> Operation:
        """Start to take a panorama, or what an earlier one lacks (``resume``); return the first record.

        Raises NotKnown, BadRequest, NotNow if camera or field do not fit the rig, or it is of another mast
        file, Unable if the disk refuses; else as `mastctl.control.operations.OperationRunner.start`. Nothing
        is left of one that is refused.
        """
        with self._unchanged() as mast:
            rig, began_s = self._rig(), self._clock.now_s()
        if body.resume is not None:
            folder = Folder(self.open(body.resume).path)
            self._check_mast(folder, mast)
            for name in folder.index.cameras:
                check_known(name, rig.cameras)
        else:
            index = self._planned(rig, body, mast.stored.digest)
            if sum(1 for _ in self._folder.glob(f"*/{INDEX}")) >= MOST:
                message = f"{MOST} panoramas are kept already; delete one of them first"
                raise BadRequest("too_many_panoramas", message)
            try:
                folder = Folder.begin(self._folder / index.id, index, mast.data)
            except BadFile as error:
                shutil.rmtree(self._folder / index.id, ignore_errors=True)
                raise Unable("unwritable", str(error)) from None

        def run(record: Callable[[Any], None], cancelled: threading.Event) -> Any:
            parts = rig, self._devices, self._clock, record, cancelled
            result = PanoramaTaker(*parts).take(folder, self._devices)
            self._newest = folder.index
            return result

        try:
            with self._unchanged() as now:
                if now is not mast:
                    raise NotNow("other_mast_file", "another mast file came into use meanwhile; try again")
                begun = self._operations.start({**recorded, "panorama": folder.index.id}, run)
        except BaseException:
            if body.resume is None:
                shutil.rmtree(folder.path, ignore_errors=True)
            raise
        if body.resume is None:  # the views of one that goes on may be of another place
            self._begun_s[folder.index.id] = began_s
        return begun

    def _planned(self, rig: Rig, body: Any, digest: str) -> Index:
        """The index of a panorama without views, as a request wants it."""
        limits = self._devices.judge.limits
        if body.camera is not None:
            check_known(body.camera, rig.cameras)
            cameras = [body.camera]
        else:
            pair = body.pair or _widest(rig)
            if pair not in rig.stereo:
                known = ", ".join(rig.stereo) or "there is none; name a camera"
                raise BadRequest(
                    "unknown_pair", f"pair '{pair[:80]}' where a stereo pair is expected: {known}"
                )
            cameras = list(rig.stereo[pair])
        if any(rig.cameras[name].on != "head" for name in cameras):
            raise BadRequest("not_on_head", f"{cameras[0]} does not turn with the head")
        pan_rad, tilt_rad = body.pan_rad or limits.pan_rad, body.tilt_rad or (-0.7, 0.2)
        views = grid_of(rig, cameras[0], tuple(pan_rad), tuple(tilt_rad), body.overlap)
        now = datetime.now(UTC)
        return Index(
            schema=SCHEMA,
            id=f"{now:%Y%m%d-%H%M%S-%f}-{secrets.token_hex(2)}",
            time=now.isoformat(timespec="seconds"),
            cameras=cameras,
            mast_digest=digest,
            pan_rad=list(pan_rad),
            tilt_rad=list(tilt_rad),
            overlap=body.overlap,
            exposure=body.exposure,
            state="running",
            views=[ViewRecord(pan_rad=pan, tilt_rad=tilt, state="wanted") for pan, tilt in views],
        )

    def listed(self) -> PanoramaList:
        """Return every panorama, the newest first; a folder without a readable index is left out."""
        found = []
        for path in sorted(self._folder.glob(f"*/{INDEX}"), reverse=True):
            try:
                found.append(_listed(self.open(path.parent.name).index))
            except (NotKnown, Unable):
                continue
        return {"panoramas": found}

    def began_s(self, name: str) -> float:
        """Return when one was begun, by this clock; -inf for one of an earlier run."""
        return self._begun_s.get(name, -math.inf)

    def slip(self, mast_digest: str) -> str:
        """Return what the newest panorama's seams say against a mast file; '' for nothing. Reads no disk."""
        newest = self._newest
        if newest is None or newest.mast_digest != mast_digest or newest.slip is None:
            return ""
        return newest.slip.sentence

    def open(self, name: str) -> Folder:
        """Return one by its id. Raises NotKnown ``panorama_unknown``, Unable ``unreadable``."""
        path = self._path(name)
        try:
            mark = (path / INDEX).stat().st_mtime_ns
            known = self._known.get(name)
            if known is None or known[0] != mark:
                known = self._known[name] = mark, Folder(path)
            folder = known[1]
            if folder.index.state == "running" and not self._runs(name):
                reason = "its end was not written: the daemon ended first, or the disk was full"
                folder.index = folder.index.model_copy(update={"state": "ended", "reason": reason})
            return folder
        except (BadFile, OSError) as error:
            raise Unable("unreadable", str(error)) from None

    def _path(self, name: str) -> Path:
        path = self._folder / name
        if "/" in name or name.startswith(".") or not path.is_dir():
            raise NotKnown("panorama_unknown", f"this daemon has no panorama {name[:80]}")
        return path

    def _runs(self, name: str) -> bool:
        """Whether a panorama is being taken."""
        running = self._operations.running
        return running is not None and self._operations.get(running).request.get("panorama") == name

    def delete(self, name: str) -> PanoramaList:
        """Delete one, its pictures too, and return all that are left.

        Raises NotKnown ``panorama_unknown``, NotNow ``busy`` while it is taken, Unable ``not_deleted``.
        """
        path = self._path(name)
        if self._runs(name):
            raise NotNow("busy", f"panorama {name} is being taken; stop it first")
        try:
            shutil.rmtree(path)
        except OSError as error:
            raise Unable("not_deleted", f"{error.filename}: {error.strerror}") from None
        self._known.pop(name, None)
        return self.listed()

    def file(self, name: str, file: str) -> Path:
        """Return a file of one. Raises NotKnown ``panorama_unknown``."""
        path = self.open(name).path / file
        if ".." in Path(file).parts or Path(file).is_absolute() or not is_plain_file(path):
            raise NotKnown("panorama_unknown", f"panorama {name} has no file {file[:80]}")
        return path

    def so_far(self, name: str) -> bytes:
        """Return what was taken so far as JPEG; drawn anew when there is more. Raises NotNow ``no_views``."""
        folder = self.open(name)
        count = len(folder.index.taken())
        if not count:
            raise NotNow("no_views", f"panorama {name} has no view yet")
        drawn = self._so_far
        if drawn is None or drawn[:2] != (name, count):
            try:
                drawn = self._so_far = name, count, so_far(folder)
            except CalibError as error:
                raise Unable("unreadable", str(error)) from None
        return drawn[2]

    def seen(self, target: PanoramaTarget) -> tuple[Seen, list[StampedFrame]]:
        """Return what a pixel shows, and its view's pictures, of the mosaic's camera first; reads the disk.

        The pictures are as if the mast file in use had been in use then, of cameras that are configured.
        Raises BadRequest, NotKnown, NotNow, Unable ``unreadable``.
        """
        folder = self.open(target.id)
        with self._unchanged() as mast:
            rig = self._rig()
        if not target.recompute:
            self._check_mast(folder, mast)
        check_known(folder.index.cameras[0], rig.cameras)
        seen = picture_at(folder, (target.x_px, target.y_px), target.view)
        frames = []
        for name in folder.index.cameras:
            if name in rig.cameras:
                try:
                    frame = folder.frame(seen.view, name)
                except BadFile as error:
                    raise Unable("unreadable", str(error)) from None
                frames.append(_recomputed(frame, rig, mast.stored.digest) if target.recompute else frame)
        return seen, frames

    def pointed(
        self, request: PointRequest, seen: Seen, frame: StampedFrame
    ) -> tuple[PointRequest, tuple[float, float] | None]:
        """Return a request at a panorama's pixel as one at its picture's, and the true angles of that view.

        ``seen`` and ``frame`` are of `seen`. By direction alone it becomes a position, without angles.
        """
        assert request.panorama is not None
        if request.panorama.by_direction:
            ray = self._rig().camera_in_rover(frame.camera, *frame.true_rad).ray(seen.pixel_px)
            position = (ray.origins_m + seen.range_m * ray.directions).tolist()
            return request.model_copy(update={"panorama": None, "position_m": position}), None
        self._devices.store.keep(frame, HOLDER, KEPT)
        x, y = seen.pixel_px.tolist()
        pixel = PixelTarget(frame.camera, frame.frame_id, x, y, frame.mast_digest)
        return request.model_copy(update={"panorama": None, "pixel": pixel}), frame.true_rad

    def _check_mast(self, folder: Folder, mast: MastLike) -> None:
        """Refuse a panorama of another mast file. Raises NotNow ``other_mast_file``."""
        taken_with, in_use = folder.index.mast_digest, mast.stored.digest
        if taken_with != in_use:
            raise NotNow(
                "other_mast_file",
                f"panorama {folder.index.id} was taken with mast file {taken_with:.8}..., the one in use is "
                f"{in_use:.8}...; recompute evaluates its angles as read by this one",
            )


def _recomputed(frame: StampedFrame, rig: Rig, digest: str) -> StampedFrame:
    """A picture with the true angles that another mast file makes of those that were read."""
    came = frame.pan_approach, frame.tilt_approach
    pan, tilt = rig.joints.true_rad((frame.pan_rad, frame.tilt_rad), came)
    name = f"{frame.frame_id}-{digest[:8]}"
    return replace(frame, frame_id=name, mast_digest=digest, true_pan_rad=pan, true_tilt_rad=tilt)


def _widest(rig: Rig) -> str:
    """The stereo pair on the head with the widest view; '' without any."""
    on_head = [name for name, (left, _) in rig.stereo.items() if rig.cameras[left].on == "head"]
    return min(on_head, key=lambda name: rig.cameras[rig.stereo[name][0]].model.focal_px[0], default="")


def _listed(index: Index) -> PanoramaListed:
    states = [view.state for view in index.views]
    return {
        "id": index.id,
        "time": index.time,
        "state": index.state,
        "reason": index.reason,
        "camera": index.cameras[0],
        "mast_digest": index.mast_digest,
        "views": {state: states.count(state) for state in sorted(set(states))},
    }
