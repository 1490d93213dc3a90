"""Going to the rests of a reference and taking its images again, once, or whenever the head is idle."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager, suppress
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np

from calib.calibrate.drift import JOINT_SIGMA_RAD, SceneDrift, ViewShift, find_drift, seen_again
from calib.errors import BadFile
from calib.files.mast_file import parse_rig
from calib.geometry.rig import Rig
from calib.matching.warp import grey
from mastctl.client import Client, ClientError
from mastctl.drift.pictures import Reference, ReferencePicture, add_look, read_looks, read_reference
from mastctl.errors import MastctlError

TURN_TIMEOUT_S = 90.0
EDGE_RAD = 0.05
TILTS_RAD = (-0.2, -0.5)
IDLE = "ready"
NOT_THE_CAMERA = frozenset({"lease_over", "lease_unknown", "leased", "no_daemon", "closing"})
"""What a snapshot is refused with where no other camera would do better."""


class LookEnded(MastctlError):
    """A look that was broken off: a stop came, or another mast file is in use."""

    code = "look_ended"


def usual_rests(client: Client) -> list[tuple[float, float]]:
    """Return six rests: three pans over the limits at two tilts, where the ground is seen."""
    limits = client.status()["limits"]
    low, high = (float(one) for one in limits["pan_rad"])
    down, up = (float(one) for one in limits["tilt_rad"])
    pans = [low + (high - low) * part for part in (1 / 6, 1 / 2, 5 / 6)]
    tilts = [min(max(tilt, down + EDGE_RAD), up - EDGE_RAD) for tilt in TILTS_RAD]
    return [(pan, tilt) for tilt in dict.fromkeys(tilts) for pan in pans]


def _in_use(client: Client, for_s: float) -> str:
    """Why the head is in use, '' if it is idle and was not used for some seconds."""
    if (control := client.control()) is not None:
        return f"{control['holder']} steers"
    status = client.status()
    state, reason = status["state"], status["reason"]
    if state != IDLE:
        return f"the daemon's state is {state}" + (f" ({reason})" if reason else "")
    since_s = float(status["state_for_s"])
    return "" if since_s >= for_s else f"the head was used {since_s:.0f} s ago; {for_s:.0f} s are waited for"


def take_pictures(
    client: Client, rests: Sequence[Sequence[float]], cameras: Sequence[str]
) -> tuple[list[ReferencePicture], dict[str, str]]:
    """Return an image of each camera at each rest (pan, tilt as read), and why a camera, or one at a rest,
    gave none; bring the head back.

    The client should have the lease. Raises LookEnded if the head is stopped, ClientError if no camera gives
    an image.
    """
    joints = client.status()["joints"]
    pictures, missing, left = list[ReferencePicture](), dict[str, str](), list(cameras)
    try:
        for pose, (pan_rad, tilt_rad) in enumerate(rests):
            _turn(client, pan_rad, tilt_rad)
            for camera in tuple(left):
                try:
                    shot = client.snapshot(camera)
                except ClientError as error:
                    if error.code in NOT_THE_CAMERA:
                        raise
                    missing[f"{camera} at rest {pose}"] = str(error)
                    if error.code == "bad_frame":
                        continue  # too dark or too bright at this rest
                    left.remove(camera)
                    if not left and not pictures:
                        raise
                    continue
                if shot.moving:
                    raise LookEnded(f"the head moved while {camera} took its picture; nothing was kept")
                pictures.append(
                    ReferencePicture(camera, pose, *shot.true_rad, shot.mast_digest, grey(shot.image))
                )
        if joints is not None:
            _turn(client, joints["pan_rad"], joints["tilt_rad"])
    except ClientError:
        if joints is not None:
            with suppress(ClientError, LookEnded):  # refused if another client steers by now
                _turn(client, joints["pan_rad"], joints["tilt_rad"])
        raise
    return pictures, missing


def _turn(client: Client, pan_rad: float, tilt_rad: float) -> None:
    operation = client.turn(pan_rad, tilt_rad, TURN_TIMEOUT_S)
    error: Mapping[str, Any] = operation.get("error") or {}
    if operation["state"] == "stopped":
        raise LookEnded(f"{error.get('message', 'the head was stopped')}; nothing was kept")
    if operation["state"] != "done":
        raise ClientError(str(error.get("code", "failed")), str(error.get("message", "the move failed")))


def head_cameras(client: Client) -> tuple[Rig, list[str]]:
    """Return the daemon's rig, and its cameras on the head that give pictures."""
    rig = parse_rig(client.mast_file(), "the daemon's mast file").rig
    served = client.status()["cameras"]
    return rig, [name for name, camera in rig.cameras.items() if camera.on == "head" and name in served]


def look_again(client: Client, reference: Reference) -> SceneDrift:
    """Take the pictures of a reference again and return what has changed.

    Nothing moves before it is known that the reference can be compared with. Raises LookEnded if another mast
    file or other cameras are in use, or the head is stopped, BadFile for a damaged reference.
    """
    if client.status()["mast"]["digest"] != reference.mast_digest:
        raise LookEnded("another mast file is in use than when the reference was taken; take a new one")
    before = reference.pictures()
    rig, served = head_cameras(client)
    cameras = [name for name in served if name in reference.cameras]
    if not cameras:
        raise LookEnded(
            f"the reference is of {', '.join(reference.cameras) or 'no camera'}, the daemon has "
            f"{', '.join(served) or 'no camera on the head'}; take a new one"
        )
    pictures, missing = take_pictures(client, reference.rests, cameras)
    if any(one.mast_digest != reference.mast_digest for one in pictures):
        raise LookEnded("another mast file came into use during the look; nothing was kept")
    drift = find_drift(rig, _view_shifts(rig, before, pictures), JOINT_SIGMA_RAD)
    gone = {name: "not configured any more" for name in reference.cameras if name not in served}
    return replace(drift, missing=gone | missing)


def _view_shifts(
    rig: Rig, before: Mapping[tuple[str, int], ReferencePicture], pictures: Sequence[ReferencePicture]
) -> list[ViewShift]:
    """How far the features of a reference have moved in new pictures. Raises LookEnded."""
    shifts = []
    for now in pictures:
        then = before.get((now.camera, now.pose))
        if then is None:
            continue
        model = rig.cameras[now.camera].model
        size_px = now.image.shape[::-1]
        if then.image.shape != now.image.shape or size_px != model.size_px:
            expected = "x".join(str(side) for side in then.image.shape[::-1])
            raise LookEnded(
                f"{now.camera}'s pictures are {size_px[0]}x{size_px[1]} where the reference has {expected}; "
                "take a new one"
            )
        pixels, moved, sigma = seen_again(model, then.image, now.image)
        if len(pixels):
            moved = moved - _reported_px(rig, then, now, pixels)  # what the head itself reports is no drift
        shifts.append(ViewShift(now.camera, now.pose, then.pan_rad, then.tilt_rad, pixels, moved, sigma))
    return shifts


def _reported_px(rig: Rig, then: ReferencePicture, now: ReferencePicture, pixels: np.ndarray) -> np.ndarray:
    """How far pixels (n, 2) move by what the joints read now and read then."""
    before = rig.camera_in_rover(then.camera, then.pan_rad, then.tilt_rad)
    after = rig.camera_in_rover(then.camera, now.pan_rad, now.tilt_rad)
    rays = before.ray(pixels)
    seen, valid = after.project(rays.origins_m + 5.0 * rays.directions)
    return np.asarray(np.where(valid[:, None], seen - pixels, 0.0))


LEASE_S = 30.0
RETRY_S = 60.0
"""After so long it is tried again, where a look is due and a client needs the head."""

NAME = "sentinel"


@contextmanager
def steering(client: Client, lease: str | None = None) -> Iterator[None]:
    """Steer alone: under a lease that was named, or one of its own, which ends with a stop of the head.

    Raises LookEnded if another client steers, or takes over.
    """
    if lease is not None:
        yield
        return
    try:
        with client.lease(NAME, for_s=LEASE_S, ends_with_stop=True):
            yield
    except ClientError as error:
        if error.code not in ("lease_over", "leased"):
            raise
        how = (error.detail or {}).get("how", error)
        raise LookEnded(f"{how}; nothing was kept") from None


def is_due(reference: Reference, last_look: str | None, every_s: float, now: datetime) -> bool:
    """Return whether a look is due: at the reference's time of day, and each ``every_s`` from it on.

    What a clock that was set back makes of it is a look too many, not none for as long.
    """

    def turn(moment: datetime) -> int:
        passed = moment - datetime.fromisoformat(reference.time).astimezone(UTC)
        return math.floor(passed.total_seconds() / every_s)

    last = reference.time if last_look is None else last_look
    return turn(now) != turn(datetime.fromisoformat(last).astimezone(UTC))


def watch(
    folder: Path,
    connect: Callable[[], AbstractContextManager[Client]],
    put_off: Callable[[str], None],
    looked: Callable[[dict[str, Any]], None],
    every_s: float,
    idle_s: float,
    sleep: Callable[[float], None] = time.sleep,
) -> None:
    """Compare every ``every_s`` seconds if the head was not used for ``idle_s``, until interrupted.

    ``put_off`` gets why nothing is done though it is due, each reason once; ``looked`` gets each result.
    Raises BadFile if there is no reference at the start; what fails later is reported, and tried again.
    """
    read_reference(folder)
    reported = ""
    while True:
        reason = ""
        try:
            reference = read_reference(folder)
            looks = read_looks(folder, reference)
            if is_due(reference, looks[-1]["time"] if looks else None, every_s, datetime.now(UTC)):
                with connect() as client:
                    reason = _in_use(client, idle_s)
                    if not reason:
                        with steering(client):
                            drift = look_again(client, reference)
                        looked(add_look(folder, reference, drift))
        except (ClientError, MastctlError, BadFile) as error:
            reason = str(error)
        if reason and reason != reported:
            put_off(f"no look now: {reason}")
        reported = reason
        sleep(min(RETRY_S, every_s / 4.0))
