"""The panoramas of a daemon: begun, gone on with, listed, and clicked."""

from __future__ import annotations

import secrets
import threading
from collections.abc import Callable, Mapping
from contextlib import AbstractContextManager
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Protocol

from calib.errors import BadFile
from calib.files.mast_file import StoredRig
from calib.geometry.rig import Rig
from drivers.clock import Clock
from mastctl.answers import PanoramaList, PanoramaListed
from mastctl.control.operations import Operation, OperationRunner
from mastctl.devices.devices import Devices
from mastctl.devices.frames import StampedFrame, check_known
from mastctl.errors import BadRequest, NotKnown, NotNow, Unable
from mastctl.motion.requests import PanoramaTarget, PixelTarget, PointRequest
from mastctl.motion.settings import PointingSettings
from mastctl.panorama.compose import Seen, picture_at, so_far
from mastctl.panorama.folder import INDEX, SCHEMA, Folder, Index, ViewRecord
from mastctl.panorama.take import PanoramaTaker, grid_of

FOLDER = "panoramas"
HOLDER = "panoramas"
KEPT = 8
"""Frames of panoramas that were clicked last stay at hand."""


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
        self._known: dict[str, tuple[int, Folder]] = {}  # as read last, with the time of the index

    def begin(self, body: Any, recorded: Mapping[str, Any]) -> Operation:
        """Start to take a panorama, or what an earlier one lacks (``resume``); return the first record.

        Raises NotKnown, BadRequest, NotNow if camera or field do not fit the rig, or it is of another mast
        file, Unable if the disk refuses; else as `mastctl.control.operations.OperationRunner.start`.
        """
        with self._unchanged() as mast:
            rig = self._rig()
            if body.resume is not None:
                folder = Folder(self.open(body.resume).path)
                self._check_mast(folder, mast)
            else:
                index = self._planned(rig, body, mast.stored.digest)
                try:
                    folder = Folder.begin(self._folder / index.id, index, mast.data)
                except BadFile as error:
                    raise Unable("unwritable", str(error)) from None
            folder.save(folder.index.model_copy(update={"state": "running", "reason": ""}))
            limits = self._devices.judge.limits

            def run(record: Callable[[Any], None], cancelled: threading.Event) -> Any:
                parts = rig, self._devices, limits, self._clock, PointingSettings(), record, cancelled
                result = PanoramaTaker(*parts).take(folder, self._devices)
                self._newest = folder.index
                return result

            try:
                return self._operations.start({**recorded, "panorama": folder.index.id}, run)
            except Exception as error:
                folder.save(folder.index.model_copy(update={"state": "ended", "reason": str(error)}))
                raise

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
            id=f"{now:%Y%m%d-%H%M%S}-{secrets.token_hex(2)}",
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

    def slip(self, mast_digest: str) -> str:
        """Return what the newest panorama's seams say against a mast file; '' for nothing. Reads no disk."""
        newest = self._newest
        if newest is None or newest.mast_digest != mast_digest or newest.slip is None:
            return ""
        return newest.slip.sentence

    def open(self, name: str) -> Folder:
        """Return one by its id. Raises NotKnown ``panorama_unknown``, Unable ``unreadable``."""
        path = self._folder / name
        if "/" in name or name.startswith(".") or not (path / INDEX).is_file():
            raise NotKnown("panorama_unknown", f"this daemon has no panorama {name[:80]}")
        try:
            mark = (path / INDEX).stat().st_mtime_ns
            known = self._known.get(name)
            if known is None or known[0] != mark:
                known = self._known[name] = mark, Folder(path)
            return known[1]
        except (BadFile, OSError) as error:
            raise Unable("unreadable", str(error)) from None

    def file(self, name: str, file: str) -> Path:
        """Return a file of one. Raises NotKnown ``panorama_unknown``."""
        path = self.open(name).path / file
        if ".." in Path(file).parts or Path(file).is_absolute() or not path.is_file():
            raise NotKnown("panorama_unknown", f"panorama {name} has no file {file[:80]}")
        return path

    def so_far(self, name: str) -> bytes:
        """Return what was taken so far as JPEG; drawn anew when there is more. Raises NotNow ``no_views``."""
        folder = self.open(name)
        count = len(folder.index.taken())
        if not count:
            raise NotNow("no_views", f"panorama {name} has no view yet")
        if self._so_far is None or self._so_far[:2] != (name, count):
            self._so_far = name, count, so_far(folder)
        return self._so_far[2]

    def camera_of(self, target: PanoramaTarget | None) -> str:
        """Return the camera that a panorama's mosaic is of. Raises NotKnown, Unable."""
        return self.open("" if target is None else target.id).index.cameras[0]

    def pointed(
        self, request: PointRequest, mast: MastLike
    ) -> tuple[PointRequest, tuple[float, float] | None]:
        """Return a request at a panorama's pixel as one at its picture's, and the true angles of that view.

        By direction alone it becomes a position, without angles. Raises BadRequest, NotKnown, NotNow.
        """
        target = request.panorama
        assert target is not None
        folder, seen = self._seen(target, mast)
        if target.by_direction:
            position = [float(one) for one in seen.point_m]
            return request.model_copy(update={"panorama": None, "position_m": position}), None
        frame = self._frame(folder, seen.view, folder.index.cameras[0], target, mast)
        self._devices.hold(frame, HOLDER, KEPT)
        x, y = (float(one) for one in seen.pixel_px)
        pixel = PixelTarget(frame.camera, frame.frame_id, x, y)
        return request.model_copy(update={"panorama": None, "pixel": pixel}), frame.true_rad

    def kept_views(self, target: PanoramaTarget, mast: MastLike) -> tuple[Seen, list[StampedFrame]]:
        """Return what a pixel shows, and the pictures of its view, of the mosaic's camera first."""
        folder, seen = self._seen(target, mast)
        return seen, [self._frame(folder, seen.view, name, target, mast) for name in folder.index.cameras]

    def _seen(self, target: PanoramaTarget, mast: MastLike) -> tuple[Folder, Seen]:
        folder = self.open(target.id)
        if not target.recompute:
            self._check_mast(folder, mast)
        check_known(folder.index.cameras[0], self._rig().cameras)
        rig = self._rig() if target.recompute else None
        return folder, picture_at(folder, (target.x_px, target.y_px), rig)

    def _frame(
        self, folder: Folder, view: int, camera: str, target: PanoramaTarget, mast: MastLike
    ) -> StampedFrame:
        """A view's picture as if the mast file in use had been in use then."""
        try:
            frame = folder.frame(view, camera)
        except BadFile as error:
            raise Unable("unreadable", str(error)) from None
        if not target.recompute:
            return frame
        came = frame.pan_approach, frame.tilt_approach
        pan, tilt = self._rig().joints.true_rad((frame.pan_rad, frame.tilt_rad), came)
        digest = mast.stored.digest
        name = f"{frame.frame_id}-{digest[:8]}"
        return replace(frame, frame_id=name, mast_digest=digest, true_pan_rad=pan, true_tilt_rad=tilt)

    def _check_mast(self, folder: Folder, mast: MastLike) -> None:
        """Refuse a panorama of another mast file. Raises NotNow ``other_mast_file``."""
        taken_with, in_use = folder.index.mast_digest, mast.stored.digest
        if taken_with != in_use:
            raise NotNow(
                "other_mast_file",
                f"panorama {folder.index.id} was taken with mast file {taken_with:.8}..., the one in use is "
                f"{in_use:.8}...; recompute evaluates its angles as read by this one",
            )


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
