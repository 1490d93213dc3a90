"""Going to the rests of a reference and taking its images again, through the daemon."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from calib.calibrate.drift import JOINT_SIGMA_RAD, ViewShift, find_drift, seen_again
from calib.files.mast_file import parse_rig
from calib.geometry.rig import Rig
from calib.matching.warp import grey
from mastctl.client import Client, ClientError
from mastctl.drift.pictures import ReferencePicture, add_look, read_reference
from mastctl.errors import MastctlError

TURN_TIMEOUT_S = 90.0
EDGE_RAD = 0.05
TILTS_RAD = (-0.2, -0.5)
LEASE_S = 30.0
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


def take_pictures(
    client: Client, rests: Sequence[Sequence[float]], cameras: Sequence[str]
) -> tuple[list[ReferencePicture], dict[str, str]]:
    """Return an image of each camera at each rest (pan, tilt as read), and why a camera, or one at a rest,
    gave none; bring the head back.

    The client should have the lease. Raises LookEnded if the head is stopped, or no camera gives an image.
    """
    joints = client.status()["joints"]
    pictures, missing = list[ReferencePicture](), dict[str, str]()
    try:
        for pose, (pan_rad, tilt_rad) in enumerate(rests):
            _turn(client, pan_rad, tilt_rad)
            for camera in cameras:
                try:
                    shot = client.snapshot(camera)
                except ClientError as error:
                    if error.code in NOT_THE_CAMERA:
                        raise
                    missing[f"{camera} at rest {pose}"] = str(error)
                    continue
                if shot.moving:
                    raise LookEnded(f"the head moved while {camera} took its image; nothing was kept")
                pictures.append(
                    ReferencePicture(camera, pose, *shot.true_rad, shot.mast_digest, grey(shot.image))
                )
        if joints is not None:
            _turn(client, joints["pan_rad"], joints["tilt_rad"])
    except ClientError:  # not after a stop
        if joints is not None:
            with suppress(ClientError, LookEnded):  # refused if another client steers by now
                _turn(client, joints["pan_rad"], joints["tilt_rad"])
        raise
    if not pictures:
        raise LookEnded(f"no camera gave an image: {next(iter(missing.values()), '')}")
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


@contextmanager
def steering(client: Client, lease: str | None = None) -> Iterator[None]:
    """Steer alone: under a lease that was named, or one of its own, which ends with a stop of the head.

    Raises LookEnded if another client steers, or takes over.
    """
    if lease is not None:
        yield
        return
    try:
        with client.lease("sentinel", for_s=LEASE_S, ends_with_stop=True):
            yield
    except ClientError as error:
        if error.code not in ("lease_over", "leased"):
            raise
        how = (error.detail or {}).get("how", error)
        raise LookEnded(f"{how}; nothing was kept") from None


def look(client: Client, folder: Path, lease: str | None = None, idle_s: float = 0.0) -> dict[str, Any]:
    """Take the images of a folder's reference again, and return the line of the look that is kept.

    Nothing moves before it is known that the reference can be compared with. Raises LookEnded if not, if the
    head is in use or was within the last ``idle_s`` seconds, and where a look ends early; BadFile without a
    reference, or for a damaged one.
    """
    reference, status = read_reference(folder), client.status()
    state, rested_s = status["state"], float(status["state_for_s"])
    if state != "ready":
        reason = f" ({status['reason']})" if status["reason"] else ""
        raise LookEnded(f"no look now: the daemon's state is {state}{reason}, and ready is expected")
    if rested_s < idle_s:
        raise LookEnded(f"no look now: the head was used {rested_s:.0f} s ago; {idle_s:.0f} s are waited for")
    if status["mast"]["digest"] != reference.mast_digest:
        raise LookEnded("another mast file is in use than when the reference was taken; take a new one")
    before = reference.pictures()
    rig, served = head_cameras(client)
    known = dict.fromkeys(camera for camera, _ in before)
    cameras = [name for name in served if name in known]
    if not cameras:
        raise LookEnded(
            f"the reference is of {', '.join(known) or 'no camera'}, the daemon has "
            f"{', '.join(served) or 'no camera on the head'}; take a new one"
        )
    with steering(client, lease):
        pictures, missing = take_pictures(client, reference.rests, cameras)
    if any(one.mast_digest != reference.mast_digest for one in pictures):
        raise LookEnded("another mast file came into use during the look; nothing was kept")
    drift = find_drift(rig, _view_shifts(rig, before, pictures), JOINT_SIGMA_RAD)
    gone = {name: "not configured any more" for name in known if name not in served}
    return add_look(folder, reference, replace(drift, missing=gone | missing))
