"""The configuration read again: all of its changes come into use while the head rests, or none.

What was opened at the start stays: drivers, cameras, the address, the state folder. A configuration that says
something else of them is refused by key, and the daemon goes on as it was.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from typing import Any

from calib.errors import BadFile
from calib.files.yaml_text import parse_mapping
from drivers.errors import BadOptions
from mastctl.answers import ConfigChange, ReloadResult
from mastctl.config import Config, check_cameras, load_config, parse_config
from mastctl.devices.judge import OutsideLimits
from mastctl.errors import BadRequest, NotNow
from mastctl.service.masts import MastInUse, read_next
from mastctl.service.service import Service

log = logging.getLogger(__name__)

FIXED: Mapping[str, tuple[Callable[[Config], object], str]] = {
    "listen": (lambda config: config.listen, "the address is taken at the start"),
    "pan_tilt": (lambda config: config.hardware.pan_tilt, "the head is opened at the start"),
    "cameras": (lambda config: config.hardware.cameras, "cameras are opened at the start"),
    "simulation": (lambda config: config.hardware.simulation, "the simulated rover is made at the start"),
    "state": (lambda config: config.state_folder, "the state folder is locked at the start"),
    "record.folder": (lambda config: config.record.folder, "recordings are opened there"),
    "tracking.handoff_log": (lambda config: config.tracking.handoff_log, "it is read at the start"),
}
"""What a running daemon cannot change, by key: what a configuration says of it, and why it cannot."""


def reload(service: Service) -> ReloadResult:
    """Read the configuration's file again and use it; return what changed and what to know of it.

    Returns ``changed``: ``key``, ``before`` and ``after`` of each, as the files have them; ``mast``: the file
    in use; ``notes``: sentences. Nothing has changed where it raises.

    Raises BadRequest ``bad_config`` if the file is none that can be used, ``bad_mast_file``; NotNow
    ``restart_needed`` if it has something else of what cannot change; ``busy``, ``moving`` if something runs
    or the head moves; DriverError if the head does not say whether it moves.
    """
    service.manager.reloading()
    try:
        return _reload(service)
    finally:
        service.manager.ready()


def _reload(service: Service) -> ReloadResult:
    before = service.config
    try:
        after = load_config(before.path)
        _refuse_fixed(before, after)
        mast = _next_mast(before, after, service)
        check_cameras(after, (mast or service.masts.in_use).stored.rig)
    except BadFile as error:
        raise BadRequest("bad_config", " ".join(str(error).split())) from None
    after = replace(after, listen=before.listen)  # as the command line may have it
    with service.masts.resting() as use:
        try:
            service.use_config(after)
        except BadOptions as error:  # the judge has not taken the limits, and nothing else had its turn
            raise BadRequest("bad_config", " ".join(str(error).split())) from None
        if mast is not None:
            use(mast)
    changed = list(_changes(before, after))
    log.info("the configuration was read again: %s", ", ".join(one["key"] for one in changed) or "as it was")
    return {"changed": changed, "mast": service.masts.in_use.as_json(), "notes": list(_notes(service))}


def _refuse_fixed(before: Config, after: Config) -> None:
    """Pass a configuration that leaves alone what cannot change. Raises NotNow ``restart_needed``."""
    was = parse_config(before.data, before.path) if before.data else before
    refused = [f"{key} ({why})" for key, (of, why) in FIXED.items() if of(was) != of(after)]
    if refused:
        message = (
            f"{before.path} has another {', '.join(refused)}; nothing was changed: restart the daemon for it"
        )
        raise NotNow("restart_needed", message)


def _next_mast(before: Config, after: Config, service: Service) -> MastInUse | None:
    """The mast file that comes into use; None if the one in use stays.

    One that a command has put into use stays as long as the configuration names the same as before.
    """
    now = service.masts.in_use
    if after.mast_file == before.mast_file and now.path != after.mast_file:
        return None
    named = read_next(after.mast_file.name, after, now, service.devices.sensor_modes)
    return None if named.stored.digest == now.stored.digest else named


def _changes(before: Config, after: Config) -> Iterator[ConfigChange]:
    """What the two files say differently, key by key."""
    old, new = (_flat(config) for config in (before, after))
    for key in sorted({*old, *new}):
        if old.get(key) != new.get(key):
            yield {"key": key, "before": old.get(key), "after": new.get(key)}


def _flat(config: Config) -> dict[str, Any]:
    """A file's keys and those one below, ``limits.pan_rad``."""
    document = parse_mapping(config.data, config.path) if config.data else {}
    flat: dict[str, Any] = {}
    for key, value in document.items():
        if isinstance(value, dict):
            flat |= {f"{key}.{name}": inner for name, inner in value.items()}
        else:
            flat[key] = value
    return flat


def _notes(service: Service) -> Iterator[str]:
    """What a person should know after it."""
    reading, limits = service.devices.last_reading, service.config.limits
    if reading is not None:
        try:
            limits.check(reading.pan_rad, reading.tilt_rad)
        except OutsideLimits as error:
            yield f"the head stands where it may not be sent any more: {error}; it may be sent back inside"
    for fault in service.devices.judge.faults(reading):
        yield fault.message
