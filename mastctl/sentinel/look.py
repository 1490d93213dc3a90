"""Going to the rests of a reference and taking the pictures again, through a running daemon."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from calib.files.mast_file import parse_rig
from calib.mast.rig import Rig
from calib.pictures.warp import grey
from calib.scene.again import seen_again
from calib.scene.drift import JOINT_SIGMA_RAD, Drift, ViewShift, find_drift
from mastctl.client import Client, ClientError
from mastctl.errors import MastctlError
from mastctl.sentinel.folder import Picture, Reference

TURN_TIMEOUT_S = 90.0
EDGE_RAD = 0.05
TILTS_RAD = (-0.2, -0.5)
IDLE = "ready"


class LookEnded(MastctlError):
    """A look that was broken off: somebody stopped the head, or another mast file is in use."""

    code = "look_ended"


def usual_rests(client: Client) -> list[tuple[float, float]]:
    """Return six rests: three pans over the limits at two tilts, where the ground is seen."""
    limits = client.status()["limits"]
    low, high = (float(one) for one in limits["pan_rad"])
    down, up = (float(one) for one in limits["tilt_rad"])
    pans = [low + (high - low) * part for part in (1 / 6, 1 / 2, 5 / 6)]
    tilts = [min(max(tilt, down + EDGE_RAD), up - EDGE_RAD) for tilt in TILTS_RAD]
    return [(pan, tilt) for tilt in dict.fromkeys(tilts) for pan in pans]


def is_idle(client: Client) -> str:
    """Return '' where a look disturbs nobody, else why it would."""
    if (control := client.control()) is not None:
        return f"{control.get('name', 'somebody')} steers"
    status = client.status()
    return "" if status["state"] == IDLE else f"the daemon's state is {status['state']}"


def take_pictures(
    client: Client,
    rests: Sequence[tuple[float, float]],
    cameras: Sequence[str],
    progress: Callable[[int, int], None] | None = None,
) -> list[Picture]:
    """Return a picture of each camera at each rest (true pan, tilt), and bring the head back to where it was.

    The client should hold the lease.

    Raises
    ------
    LookEnded
        If somebody stops the head.
    ClientError
        If the daemon refuses, or a camera fails.
    """
    joints = client.status()["joints"]
    pictures = []
    for pose, (pan_rad, tilt_rad) in enumerate(rests):
        _turn(client, pan_rad, tilt_rad)
        for camera in cameras:
            shot = client.snapshot(camera)
            if shot.moving:
                raise LookEnded(f"the head moved while {camera} took its picture; nothing was kept")
            pictures.append(Picture(camera, pose, *shot.true_rad, shot.mast_digest, grey(shot.image)))
        if progress is not None:
            progress(pose + 1, len(rests))
    if joints is not None:
        _turn(client, float(joints["pan_rad"]), float(joints["tilt_rad"]))
    return pictures


def _turn(client: Client, pan_rad: float, tilt_rad: float) -> None:
    operation = client.wait(client.point(pan_rad=pan_rad, tilt_rad=tilt_rad), timeout_s=TURN_TIMEOUT_S)
    if operation["state"] == "stopped":
        raise LookEnded("somebody stopped the head; nothing was kept")
    if operation["state"] != "done":
        told: Mapping[str, Any] = operation.get("error") or {}
        raise ClientError(str(told.get("code", "failed")), str(told.get("message", "the move failed")))


def head_cameras(client: Client) -> tuple[Rig, list[str]]:
    """Return the daemon's rig, and its cameras on the head that give pictures."""
    rig = parse_rig(client.mast_file(), "the daemon's mast file").rig
    served = client.status()["cameras"]
    return rig, [name for name, camera in rig.cameras.items() if camera.on == "head" and name in served]


def look_again(
    client: Client, reference: Reference, progress: Callable[[int, int], None] | None = None
) -> Drift:
    """Take the pictures of a reference again and return what has changed.

    Raises
    ------
    LookEnded
        If another mast file is in use than at the reference, or somebody stops the head.
    """
    rig, cameras = head_cameras(client)
    pictures = take_pictures(client, reference.rests, cameras, progress)
    if any(one.mast_digest != reference.mast_digest for one in pictures):
        raise LookEnded("another mast file is in use than when the reference was taken; take a new one")
    return compared(rig, reference, pictures)


def compared(
    rig: Rig, reference: Reference, pictures: Sequence[Picture], joint_sigma_rad: float = JOINT_SIGMA_RAD
) -> Drift:
    """Return what has changed between a reference and new pictures. Raises BadFile."""
    shifts = []
    for now in pictures:
        then = reference.picture(now.camera, now.pose)
        model = rig.cameras[now.camera].model
        if then is None or then.image.shape != now.image.shape or now.image.shape[::-1] != model.size_px:
            continue
        pixels, moved, sigma = seen_again(model, then.image, now.image)
        if len(pixels):
            # what the head itself tells that it stands elsewhere is no drift
            moved = moved - _told_px(rig, then, now, pixels)
        shifts.append(ViewShift(now.camera, now.pose, then.pan_rad, then.tilt_rad, pixels, moved, sigma))
    return find_drift(rig, shifts, joint_sigma_rad)


def _told_px(rig: Rig, then: Picture, now: Picture, pixels: np.ndarray) -> np.ndarray:
    """How far pixels (n, 2) move by what the joints read now and read then."""
    before = rig.camera_in_rover(then.camera, then.pan_rad, then.tilt_rad)
    after = rig.camera_in_rover(then.camera, now.pan_rad, now.tilt_rad)
    rays = before.ray(pixels)
    seen, valid = after.project(rays.origins_m + 5.0 * rays.directions)
    return np.asarray(np.where(valid[:, None], seen - pixels, 0.0))
