"""The mast file in use: its bytes as they were read, and what another must fulfil to take its place."""

from __future__ import annotations

import logging
from collections.abc import Iterable
from dataclasses import dataclass, replace
from pathlib import Path

from calib.errors import BadFile, CalibError
from calib.files import read_bytes
from calib.files.mast_file import StoredRig, parse_rig
from calib.files.yaml_text import MAX_BYTES
from calib.geometry.covariance import stored_covariance
from calib.geometry.rig import Rig
from mastctl.answers import MastTold
from mastctl.config import Config, check_cameras
from mastctl.devices.opening import Bounds
from mastctl.errors import BadRequest
from mastctl.safety.state_folder import folder_of

log = logging.getLogger(__name__)


class BadMastFile(BadRequest):
    """A mast file that cannot take the place of the one in use; the sentence says why."""

    def __init__(self, message: str) -> None:
        super().__init__("bad_mast_file", message)


@dataclass(frozen=True, eq=False)
class MastInUse:
    """A mast file as read, and its bytes: what the file holds later does not matter."""

    stored: StoredRig
    data: bytes
    path: Path

    def told(self) -> MastTold:
        """Return its file, name and digest as JSON."""
        return {"file": self.path.name, "name": self.stored.rig.name, "digest": self.stored.digest}


def read_mast(path: Path, config: Config) -> MastInUse:
    """Read a mast file for a configuration.

    Raises
    ------
    BadFile
        If it cannot be used, or lacks a configured camera.
    """
    data = read_bytes(path, MAX_BYTES)
    stored = parse_rig(data, path)
    check_cameras(config, stored.rig)
    return MastInUse(stored, data, path)


def read_next(name: str, config: Config, now: MastInUse) -> MastInUse:
    """Read the mast file that shall take the place of another.

    Parameters
    ----------
    name
        Of a file in the folder of the configured mast file, without any folder.
    config
        Names the folder, and the cameras that it must have.
    now
        The one in use: configured cameras must be mounted alike and take images of the same size.

    Raises
    ------
    BadMastFile
        If it may not, cannot be read, or does not fit.
    """
    folder = config.mast_file.parent
    if Path(name).name != name or name.startswith(".") or "\\" in name or "\0" in name:
        raise BadMastFile(
            f"file is '{name[:80]}' where the plain name of a file beside the configured one is expected"
        )
    path = folder / name
    if not path.is_file():
        raise BadMastFile(
            f"there is no file {name[:80]} beside the configured mast file {config.mast_file.name}"
        )
    try:
        data = read_bytes(path, MAX_BYTES)
        stored = parse_rig(data, name)
    except BadFile as error:
        raise BadMastFile(str(error)) from None
    for camera in config.hardware.cameras:
        _check_camera(camera, stored, now.stored)
    return MastInUse(stored, data, path)


def configured(rig: Rig, cameras: Iterable[str]) -> Rig:
    """Return the part of a rig that this daemon can see with: nothing is aimed with a camera it lacks."""
    names = set(cameras)
    fit = {key: value for key, value in rig.fit.items() if key not in ("parameters", "covariance")}
    try:
        known = stored_covariance(rig)
    except CalibError as error:
        log.warning("the calibration counts as exact: %s", error)
        known = None
    if known is not None:
        part = known.of(tuple(names))
        fit |= {"parameters": list(part.names), "covariance": part.covariance.tolist()}
    return replace(
        rig,
        fit=fit,
        cameras={name: camera for name, camera in rig.cameras.items() if name in names},
        stereo={pair: eyes for pair, eyes in rig.stereo.items() if names.issuperset(eyes)},
    )


def _check_camera(camera: str, stored: StoredRig, now: StoredRig) -> None:
    """Refuse a file whose camera is not the one that is mounted."""
    if camera not in stored.rig.cameras:
        known = ", ".join(stored.rig.cameras)
        raise BadMastFile(f"{stored.path.name} has no camera {camera}, which is configured; it has {known}")
    new, old = stored.rig.cameras[camera], now.rig.cameras[camera]
    if new.on != old.on:
        raise BadMastFile(f"{stored.path.name} has {camera} on the {new.on} where it is on the {old.on}")
    if new.model.size_px != old.model.size_px:
        sizes = ["x".join(map(str, entry.model.size_px)) for entry in (new, old)]
        raise BadMastFile(f"{stored.path.name} has {camera} with {sizes[0]} px where it takes {sizes[1]} px")


def bounds_of(config: Config) -> Bounds:
    """Return what bounds the moves of a configuration's head. Raises BadFile, as `read_mast`."""
    state = folder_of(config.state_folder, config.path, config.listen.url)
    return Bounds(config.limits, read_mast(config.mast_file, config).stored, config.sun, state)
