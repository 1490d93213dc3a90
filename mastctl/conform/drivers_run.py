"""All checks of one head or camera, opened by its driver's name or out of a configuration."""

from __future__ import annotations

import logging
import math
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import replace
from typing import Any

from drivers.errors import BadOptions, DriverError
from drivers.faults import PAN_TILT
from drivers.hardware import DeviceSettings, HardwareSettings
from drivers.interfaces import Camera, PanTilt
from drivers.open_hardware import CAMERAS as CAMERA_DRIVERS
from drivers.open_hardware import HEADS as HEAD_DRIVERS
from drivers.open_hardware import open_hardware, open_one_camera
from mastctl.conform.cameras import CAMERAS, CameraTrial
from mastctl.conform.checks import Check, Outcome, PromiseBroken, SubjectLost, run_checks
from mastctl.conform.head_trial import Angles, HeadTrial
from mastctl.conform.heads import HEADS
from mastctl.conform.report import Report
from mastctl.conform.worker import beside

log = logging.getLogger(__name__)

COUNTS = {"dynamixel": 3, "flir_ptu": 1}
"""How many counts from its goal a head of this repository may stand when it calls itself settled."""

STOPS_WITHIN_S = 3.0


def kind_of(driver: str) -> str:
    """Return ``head`` or ``camera`` for a driver of this repository that is one of them, else nothing."""
    return "head" if driver in HEAD_DRIVERS else "camera" if driver in CAMERA_DRIVERS else ""


def device_settings(driver: str, options: Mapping[str, Any], kind: str, name: str) -> HardwareSettings:
    """Return the settings that open one device by its driver.

    The options of ``sim`` are the section ``simulation``, over that of the packaged rover.
    """
    if driver == "sim":
        from mastctl.config import load_config

        packaged = load_config(None).hardware
        simulation = {**packaged.simulation, **options}
        settings = replace(packaged, cameras={}, simulation=simulation, pan_tilt=DeviceSettings("sim"))
        return replace(settings, cameras={name: DeviceSettings("sim")}) if kind == "camera" else settings
    device = DeviceSettings(driver, options)
    if kind == "camera":
        return HardwareSettings(DeviceSettings("none"), {name: device})
    return HardwareSettings(device, {})


@contextmanager
def head_under_test(
    settings: HardwareSettings, reach_rad: float, speed_rad_per_s: float,
    limits_rad: tuple[Angles, Angles] | None, own_limits: bool,
) -> Iterator[HeadTrial]:  # fmt: skip
    """Open a head; leaving stops and closes it.

    Parameters
    ----------
    settings
        What opens it.
    reach_rad, speed_rad_per_s
        How far from where it stands it may be moved (infinite: over all of the limits), and how fast.
    limits_rad
        The ends that it may not pass; None: not known.
    own_limits
        Whether these are the driver's own: it is sent to them, and a hair beyond, which it has to refuse.
    """
    count_rad = count_of(settings.pan_tilt)
    with ExitStack() as stack:

        def opened() -> PanTilt:
            head: PanTilt = stack.enter_context(open_hardware(replace(settings, cameras={}))).pan_tilt
            return head

        trial = HeadTrial(
            opened(), ((0.0, 0.0), (0.0, 0.0)), speed_rad_per_s,
            limits_rad=limits_rad if own_limits or math.isinf(reach_rad) else None, own_limits=own_limits,
            count_rad=count_rad, open_again=None if settings.pan_tilt.driver == "sim" else opened,
        )  # fmt: skip
        if count_rad is not None:
            trial.settle_rad = COUNTS[settings.pan_tilt.driver] * count_rad
        try:
            ends = limits_rad or ((-math.pi, math.pi), (-math.pi / 2, math.pi / 2))
            try:
                first = trial.read()
            except (PromiseBroken, SubjectLost, DriverError) as reason:  # the checks have to tell of it
                trial.unplaced = str(reason)
            else:
                trial.box_rad = (
                    box(first.pan_rad, ends[0], reach_rad),
                    box(first.tilt_rad, ends[1], reach_rad),
                )
            yield trial
        finally:
            trial.worker.close()


def box(at_rad: float, ends_rad: Angles, reach_rad: float) -> Angles:
    """Return where an axis may be moved: as far as the reach about where it stands, inside its ends."""
    low, high = ends_rad
    width = min(2 * reach_rad, high - low)
    start = min(max(at_rad - width / 2, low), high - width)
    return start, start + width


@contextmanager
def camera_under_test(
    settings: HardwareSettings, name: str, size_px: tuple[int, int] | None, seconds: float, with_head: bool
) -> Iterator[CameraTrial]:
    """Open a camera, after the head if it is one of a simulator that looks from it; leaving closes it."""
    with ExitStack() as stack:
        if with_head:
            stack.enter_context(open_hardware(replace(settings, cameras={})))

        def opened() -> Camera:
            return stack.enter_context(open_one_camera(settings, name))

        again = None if settings.cameras[name].driver in ("sim", "replay") else opened
        yield CameraTrial(name, opened(), size_px, seconds, again)


def check_head(
    trial: HeadTrial, driver: str, checks: Sequence[Check[HeadTrial]], motion: bool,
    tell: Callable[[Outcome], object] = lambda outcome: None,
) -> Report:  # fmt: skip
    """Run checks on a head, and stop it however they end, by Ctrl-C too."""
    began_s = time.time()
    may_move = ""
    try:
        outcomes = run_checks(checks, trial, motion=motion, tell=tell)
    finally:
        if motion and not trial.closed and any(check.moves for check in checks):
            may_move = _stopped(trial)
    return Report("head", driver, began_s, outcomes, may_move)


def _stopped(trial: HeadTrial) -> str:
    """Stop the head; return why it may still move, empty when it has confirmed."""
    stop = beside(trial.head.stop)
    try:
        stop.result(STOPS_WITHIN_S)
    except KeyboardInterrupt:
        with suppress(Exception):
            stop.result(STOPS_WITHIN_S)
        raise
    except BaseException as error:
        words = f"the stop at the end failed, the head may still move: {type(error).__name__}: {error}"
        log.error("%s", words)
        return words
    return ""


def check_camera(
    trial: CameraTrial, driver: str, checks: Sequence[Check[CameraTrial]],
    tell: Callable[[Outcome], object] = lambda outcome: None,
) -> Report:  # fmt: skip
    """Run checks on a camera."""
    began_s = time.time()
    return Report("camera", driver, began_s, run_checks(checks, trial, motion=False, tell=tell))


def count_of(device: DeviceSettings) -> float | None:
    """Return one count of a head of this repository, radians, the coarser axis; None for another."""
    options = device.options
    if device.driver == "dynamixel":
        from drivers.dynamixel.models import model_named

        try:
            return float(max(model_named(options[axis]["model"]).count_rad for axis in ("pan", "tilt")))
        except (LookupError, TypeError):
            raise BadOptions("pan.model and tilt.model are expected", device=PAN_TILT) from None
    if device.driver == "flir_ptu":
        from drivers.flir_ptu.workshop import facts

        found = facts(str(options.get("port")), int(options.get("baud", 9600)))
        return math.radians(max(found.pan.resolution_arcsec, found.tilt.resolution_arcsec) / 3600)
    return None


ALL: Mapping[str, Sequence[Check[Any]]] = {"head": HEADS.checks, "camera": CAMERAS.checks}
