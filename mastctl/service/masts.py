"""The mast file in use, as it was read, and the one before it: changed only while the head rests."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path

from calib.errors import BadFile, CalibError
from calib.files import is_plain_file, read_bytes
from calib.files.mast_file import StoredRig, parse_rig
from calib.files.yaml_text import MAX_BYTES
from calib.geometry.covariance import stored_covariance
from calib.geometry.mode import SensorMode
from calib.geometry.rig import Rig
from drivers.errors import BadFrame
from mastctl.answers import MastAnswer
from mastctl.config import Config, check_cameras
from mastctl.control.machine import StateMachine
from mastctl.control.operations import OperationRunner
from mastctl.devices.devices import Devices
from mastctl.devices.frames import check_mode
from mastctl.devices.opening import Bounds
from mastctl.errors import BadRequest, NotNow
from mastctl.safety.state_folder import folder_of

log = logging.getLogger(__name__)


class BadMastFile(BadRequest):
    """A mast file that cannot take the place of the one in use."""

    def __init__(self, message: str) -> None:
        super().__init__("bad_mast_file", message)


@dataclass(frozen=True, eq=False)
class MastInUse:
    """A mast file as read, and its bytes: what the file holds later does not matter.

    ``rig`` is its part that is configured.
    """

    stored: StoredRig
    data: bytes
    path: Path
    rig: Rig

    def as_json(self) -> MastAnswer:
        """Return its file, name and digest as JSON."""
        return {"file": self.path.name, "name": self.stored.rig.name, "digest": self.stored.digest}


def read_mast(path: Path, config: Config) -> MastInUse:
    """Read a mast file for a configuration. Raises BadFile if it lacks a configured camera, too."""
    data = read_bytes(path, MAX_BYTES)
    stored = parse_rig(data, path)
    check_cameras(config, stored.rig)
    return MastInUse(stored, data, path, _configured(stored.rig, config))


def read_next(name: str, config: Config, now: MastInUse, sensor_modes: Mapping[str, SensorMode]) -> MastInUse:
    """Read the mast file that shall take the place of the one in use, ``now``.

    ``name`` is that of a file in the folder of the configured one. Its configured cameras must be mounted
    alike, have the same image sizes, and the ``sensor_modes`` of cameras that know theirs. Raises
    BadMastFile.
    """
    folder = config.mast_file.parent
    if Path(name).name != name or name.startswith(".") or "\\" in name or "\0" in name:
        raise BadMastFile(
            f"file is '{name[:80]}' where the plain name of a file beside the configured one is expected"
        )
    path = folder / name
    if not is_plain_file(path):
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
    found = MastInUse(stored, data, path, _configured(stored.rig, config))
    if stored.digest != now.stored.digest:  # the one in use is no change, whatever joined since
        _check_modes(found, sensor_modes)
    return found


def _check_modes(mast: MastInUse, sensor_modes: Mapping[str, SensorMode]) -> None:
    """Pass a mast file that has the modes of the cameras that know theirs. Raises BadMastFile."""
    for camera, mode in sensor_modes.items():
        calibrated = mast.stored.rig.cameras[camera].sensor_mode
        if calibrated is not None:
            try:
                check_mode(camera, mode, calibrated)
            except BadFrame as error:
                raise BadMastFile(f"{mast.path.name}: {error}") from None


def _configured(rig: Rig, config: Config) -> Rig:
    """Return the part of a rig that is configured: nothing is aimed with an absent camera."""
    names = set(config.hardware.cameras)
    fit = {key: value for key, value in rig.fit.items() if key not in ("parameters", "covariance")}
    try:
        known = stored_covariance(rig)
    except CalibError as error:
        log.warning("the calibration is treated as exact: %s", error)
        known = None
    if known is not None:
        part = known.of(tuple(names))
        fit |= {"parameters": list(part.names), "covariance": part.covariance.tolist()}
    return replace(
        rig,
        fit=fit,
        cameras={name: camera for name, camera in rig.cameras.items() if name in names},
        stereo={pair: both for pair, both in rig.stereo.items() if names.issuperset(both)},
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


class Masts:
    """The mast files of one daemon; safe to use from any thread.

    ``first``: the one that the configuration names; ``follow``: has everything use another one from now on.

    ``in_use``, ``former``: replaced as a whole, never edited; read without a lock.
    """

    def __init__(
        self,
        config: Config,
        first: MastInUse,
        devices: Devices,
        operations: OperationRunner,
        machine: StateMachine,
        follow: Callable[[MastInUse], None],
    ) -> None:
        self.in_use = first
        self.former: MastInUse | None = None
        self._config = config
        self._devices = devices
        self._operations = operations
        self._machine = machine
        self._follow = follow
        self._lock = threading.Lock()
        machine.publisher.publish("mast", "in_use", first.as_json())

    @contextmanager
    def unchanged(self) -> Iterator[MastInUse]:
        """Let no other come into use inside the block: nothing starts between one and the next."""
        with self._lock:
            yield self.in_use

    def load(self, name: str) -> MastInUse:
        """Use another mast file of the configured one's folder from now on, and return it.

        Frames taken before are refused from then on. The file before it stays at hand for `back`. Nothing has
        changed where it raises: BadMastFile; NotNow ``busy``, ``moving``; DriverError if the head does not
        answer.
        """
        return self._use(read_next(name, self._config, self.in_use, self._devices.sensor_modes))

    def back(self) -> MastInUse:
        """Go back to the mast file that was in use before, as it was then; the second time forth again.

        Raises NotNow ``no_former_mast`` if none was loaded since the start; else as `load`, for a camera may
        have joined in another mode.
        """
        former = self.former
        if former is None:
            raise NotNow("no_former_mast", "no other mast file was in use since the daemon started")
        _check_modes(former, self._devices.sensor_modes)
        return self._use(former)

    def _use(self, mast: MastInUse) -> MastInUse:
        self._operations.let_stopped_end()
        self._devices.read()  # the machine knows whether it moves now
        with self._lock:
            refusal = self._machine.standing.refusal("rest")
            if refusal is not None:
                raise refusal
            self._follow(mast)
            self.in_use, self.former = mast, self.in_use
            self._machine.publisher.publish("mast", "in_use", mast.as_json())
        for note in mast.stored.notes:
            log.warning("%s", note)
        log.info("mast file %s (%s) is in use", mast.path.name, mast.stored.digest[:12])
        return mast
