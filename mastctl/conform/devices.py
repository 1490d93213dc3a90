"""All checks of one head or camera, opened by its driver's name or out of a configuration."""

from __future__ import annotations

import logging
import math
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import replace
from typing import Any

from drivers.clock import SystemClock
from drivers.errors import DriverError
from drivers.hardware import DeviceSettings, HardwareSettings, is_hardware
from drivers.interfaces import Camera
from drivers.registry import kinds_of
from mastctl.conform.camera_checks import CAMERAS, CameraTrial
from mastctl.conform.checks import (
    Check,
    CheckOutcome,
    ConformReport,
    PromiseBroken,
    SubjectLost,
    run_checks,
)
from mastctl.conform.head_checks import HEADS
from mastctl.conform.head_trial import Angles, HeadTrial, at, box
from mastctl.conform.worker import beside
from mastctl.devices.limits import Limits
from mastctl.devices.opening import Bounds, head_beside, open_one_camera

log = logging.getLogger(__name__)

STOPS_WITHIN_S = 3.0
ANYWHERE: tuple[Angles, Angles] = ((-math.pi, math.pi), (-math.pi / 2, math.pi / 2))
"""Where a head may be moved of which nothing is known."""


def kind_of(driver: str) -> str:
    """Return ``head`` or ``camera`` for a driver that an installed package offers for one of them alone."""
    kinds = kinds_of(driver)
    return kinds.pop() if len(kinds) == 1 else ""


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
    settings: HardwareSettings, bounds: Bounds | None, reach_rad: float, speed_rad_per_s: float,
    own_limits_rad: tuple[Angles, Angles] | None, *, moves: bool,
) -> Iterator[HeadTrial]:  # fmt: skip
    """Open a head through the door (`mastctl.devices.opening`); leaving stops and closes it.

    Parameters
    ----------
    settings
        What opens it.
    bounds
        Of its configuration; None: it has none.
    reach_rad, speed_rad_per_s
        How far from where it stands it may be moved (infinite: over all of the limits), and how fast.
    own_limits_rad
        The driver's own ends, where they are known: it is sent to them, and a hair beyond, which it has to
        refuse.
    moves
        Whether it is to be moved at all.

    Raises
    ------
    Estopped, StateInUse, DriverError
        As `mastctl.devices.opening.devices_beside`.
    """
    ends = own_limits_rad or ANYWHERE
    if bounds is None:
        bounds = Bounds(Limits(*ends, speed_rad_per_s))
    elif own_limits_rad is None:
        ends = bounds.limits.pan_rad, bounds.limits.tilt_rad
    known = own_limits_rad is not None or bounds.stored is not None
    with head_beside(settings, bounds, SystemClock(), moves=moves) as opened:
        head = opened()
        counts_rad = head.door.counts_rad.values()
        count_rad = max(counts_rad) if len(counts_rad) == 2 else None
        again = not is_hardware("simulated", "head", settings.pan_tilt.driver)
        trial = HeadTrial(
            head, ((0.0, 0.0), (0.0, 0.0)), min(speed_rad_per_s, bounds.limits.speed_rad_per_s),
            limits_rad=ends if own_limits_rad is not None or (known and math.isinf(reach_rad)) else None,
            own_limits=own_limits_rad is not None,
            count_rad=count_rad, open_again=opened if again else None,
        )  # fmt: skip
        if count_rad is not None:
            trial.settle_rad = head.info.settles_within_counts * count_rad
        try:
            try:
                first = trial.read()
            except (PromiseBroken, SubjectLost, DriverError) as reason:  # the checks have to tell of it
                trial.unplaced = f"it is not known from where: {reason}"
            else:
                room = head.door.room(at(first))
                if room is None:
                    trial.unplaced = "it stands in a keep-out, or too near to one"
                else:
                    trial.box_rad = (
                        box(first.pan_rad, room.pan_rad, reach_rad),
                        box(first.tilt_rad, room.tilt_rad, reach_rad),
                    )
            yield trial
        finally:
            trial.worker.close()


@contextmanager
def camera_under_test(
    settings: HardwareSettings,
    name: str,
    size_px: tuple[int, int] | None,
    seconds: float,
    with_head: Bounds | None,
) -> Iterator[CameraTrial]:
    """Open a camera, after the head if it is one of a simulator that looks from it; leaving closes it.

    ``with_head`` bounds that head, which is not moved; None: it is not opened.
    """
    with ExitStack() as stack:
        if with_head is not None:
            stack.enter_context(head_beside(settings, with_head, SystemClock(), moves=False))()

        def opened() -> Camera:
            return stack.enter_context(open_one_camera(settings, name))

        again = None if not is_hardware("real", "camera", settings.cameras[name].driver) else opened
        yield CameraTrial(name, opened(), size_px, seconds, again)


def check_head(
    trial: HeadTrial, driver: str, checks: Sequence[Check[HeadTrial]], motion: bool,
    tell: Callable[[CheckOutcome], object] = lambda outcome: None,
) -> ConformReport:  # fmt: skip
    """Run checks on a head, and stop it however they end, by Ctrl-C too."""
    began_s = time.time()
    may_move = ""
    try:
        outcomes = run_checks(checks, trial, motion=motion, tell=tell)
    finally:
        if motion and not trial.closed and any(check.moves for check in checks):
            may_move = _stopped(trial)
    return ConformReport("head", driver, began_s, outcomes, may_move)


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
    tell: Callable[[CheckOutcome], object] = lambda outcome: None,
) -> ConformReport:  # fmt: skip
    """Run checks on a camera."""
    began_s = time.time()
    return ConformReport("camera", driver, began_s, run_checks(checks, trial, motion=False, tell=tell))


ALL: Mapping[str, Sequence[Check[Any]]] = {"head": HEADS.checks, "camera": CAMERAS.checks}
