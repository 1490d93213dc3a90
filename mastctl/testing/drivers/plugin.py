"""Options and fixtures of the acceptance of drivers: opens the head and the cameras that the tests are given.

`mastctl.testing.plugin` loads it where ``mastctl.testing.drivers`` is on pytest's command line.
"""

from __future__ import annotations

import json
import logging
import math
from collections.abc import Generator, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from pathlib import Path

import pytest

from calib.errors import BadFile
from drivers.clock import SystemClock
from drivers.errors import DriverError
from drivers.hardware import DeviceSettings, HardwareSettings, is_hardware
from drivers.interfaces import Camera
from mastctl.config import load_config
from mastctl.conform.device_checks import CameraTrial, NotTried, PromiseBroken, SubjectLost, beside
from mastctl.conform.rig import Angles, box
from mastctl.devices.judge import Limits
from mastctl.devices.opening import Bounds, head_beside, open_one_camera
from mastctl.errors import MastctlError
from mastctl.service.masts import bounds_of
from mastctl.testing.drivers.test_head import HeadTrial, at

log = logging.getLogger(__name__)

STOPS_WITHIN_S = 3.0
ANYWHERE: tuple[Angles, Angles] = ((-math.pi, math.pi), (-math.pi / 2, math.pi / 2))
"""Where a head may be moved of which nothing is known."""
SIMULATED_CAMERA = "navcam_left"
HARDWARE = pytest.StashKey[tuple[HardwareSettings, Bounds | None]]()


def pytest_addoption(parser: pytest.Parser) -> None:
    """Add the options that name a driver and bound its moves."""
    group = parser.getgroup("drivers", "acceptance of mastctl drivers")
    group.addoption("--rig", metavar="FILE", help="test the head and the cameras of this configuration")
    group.addoption("--head", metavar="DRIVER", help="a head's driver: package.module:factory, or its name")
    group.addoption("--camera", metavar="DRIVER", help="a camera's driver")
    group.addoption("--options", metavar="JSON", default="{}", help="the driver's options")
    group.addoption(
        "--motion", action="store_true", help="move the head; a simulated one is moved without it"
    )
    group.addoption(
        "--reach", type=float, default=0.3, metavar="RAD",
        help="how far from its pose the head is moved (default 0.3 rad; inf: over all of its limits)",
    )  # fmt: skip
    group.addoption("--speed", type=float, default=0.5, metavar="RAD/S", help="of every move (default 0.5)")
    group.addoption(
        "--limits", type=float, nargs=4, metavar=("PAN", "PAN", "TILT", "TILT"),
        help="the head driver's own lowest and highest angles, radians; they are tried",
    )  # fmt: skip
    group.addoption(
        "--seconds", type=float, default=3.0, metavar="S", help="how long frames are taken (default 3)"
    )


def pytest_configure(config: pytest.Config) -> None:
    """Refuse options that cannot be."""
    option = config.option
    if [option.rig, option.head, option.camera].count(None) != 2:
        raise pytest.UsageError("--head DRIVER, --camera DRIVER or --rig FILE is expected, one of them")
    if option.reach <= 0.0 or option.speed <= 0.0 or option.seconds <= 0.0:
        raise pytest.UsageError("--reach, --speed and --seconds: numbers above zero are expected")
    for low, high in _own_limits(config) or ():
        if not low < high:
            raise pytest.UsageError(f"--limits: {low:g} {high:g} where the lower angle first is expected")
    try:
        config.stash[HARDWARE] = _hardware(config)
    except BadFile as error:
        raise pytest.UsageError(str(error)) from None


def pytest_generate_tests(metafunc: pytest.Metafunc) -> None:
    """Give the tests of cameras each camera that the command line names."""
    if "camera_name" in metafunc.fixturenames:
        cameras = metafunc.config.stash[HARDWARE][0].cameras
        metafunc.parametrize("camera_name", list(cameras), scope="session")


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Function]) -> None:
    """Leave out the tests of what the command line does not name."""
    heads, cameras = config.option.camera is None, config.stash[HARDWARE][0].cameras
    items[:] = [one for one in items if (heads if "head" in one.fixturenames else cameras)]


@pytest.hookimpl(wrapper=True)
def pytest_pyfunc_call(pyfuncitem: pytest.Function) -> Generator[None, object, object]:
    """Skip what does not apply, and end the run when the device does not answer any more."""
    try:
        return (yield)
    except NotTried as reason:
        pytest.skip(str(reason))
    except SubjectLost as reason:
        pyfuncitem.session.shouldstop = str(reason)
        raise


@pytest.fixture(scope="session")
def opened_head(request: pytest.FixtureRequest) -> Iterator[HeadTrial]:
    """The head under test, opened once; stopped and closed at the end."""
    option, moves = request.config.option, _may_move(request.config)
    settings, bounds = request.config.stash[HARDWARE]
    if is_hardware("replayed", "head", settings.pan_tilt.driver):
        pytest.skip("a replayed head is at recorded poses only; there is no motion to test")
    own = _own_limits(request.config)
    with (
        _refusals(),
        head_under_test(settings, bounds, option.reach, option.speed, own, moves=moves) as trial,
    ):
        yield trial
        if moves and not trial.closed:
            _stop(trial)


@pytest.fixture
def head(request: pytest.FixtureRequest, opened_head: HeadTrial) -> HeadTrial:
    """The head under test, where the test may have it moved."""
    if request.node.get_closest_marker("moves_head") is not None and not _may_move(request.config):
        pytest.skip("the head is moved only with --motion")
    return opened_head


@pytest.fixture(scope="session")
def camera(request: pytest.FixtureRequest, camera_name: str) -> Iterator[CameraTrial]:
    """A camera under test, after the head if it is one of a simulator that looks from it."""
    settings, bounds = request.config.stash[HARDWARE]
    device, size_px = settings.cameras[camera_name], None
    with _refusals(), ExitStack() as stack:
        if bounds is not None:
            assert bounds.stored is not None
            size_px = bounds.stored.rig.cameras[camera_name].model.size_px
            if is_hardware("simulated", "camera", device.driver):
                stack.enter_context(head_beside(settings, bounds, SystemClock(), moves=False))()

        def opened() -> Camera:
            one = replace(settings, cameras={camera_name: device})
            return stack.enter_context(open_one_camera(one, camera_name))

        again = opened if is_hardware("real", "camera", device.driver) else None
        yield CameraTrial(camera_name, opened(), size_px, request.config.option.seconds, again)


@contextmanager
def head_under_test(
    settings: HardwareSettings, bounds: Bounds | None, reach_rad: float, speed_rad_per_s: float,
    own_limits_rad: tuple[Angles, Angles] | None, *, moves: bool,
) -> Iterator[HeadTrial]:  # fmt: skip
    """Open a head whose moves are judged (`mastctl.devices.opening`); leaving closes it.

    An infinite ``reach_rad`` is all of the limits. ``own_limits_rad`` are the driver's own ends, where they
    are known: the head is sent to them, and just beyond, which its driver has to refuse. Raises as
    `mastctl.devices.opening.devices_beside`, and SubjectLost if it is not known where it may be moved.
    """
    bounds = bounds or Bounds(Limits(*(own_limits_rad or ANYWHERE), speed_rad_per_s))
    speed_rad_per_s = min(speed_rad_per_s, bounds.limits.speed_rad_per_s)
    with head_beside(settings, bounds, SystemClock(), moves=moves) as opened:
        head = opened()
        again = not is_hardware("simulated", "head", settings.pan_tilt.driver)
        trial = HeadTrial(
            head, ((0.0, 0.0), (0.0, 0.0)), speed_rad_per_s,
            limits_rad=own_limits_rad, open_again=opened if again else None,
        )  # fmt: skip
        if len(head.judge.counts_rad) == 2:
            trial.count_rad = max(head.judge.counts_rad.values())
            trial.settle_rad = head.info.settles_within_counts * trial.count_rad
        if moves:
            try:
                first = trial.read()
            except (PromiseBroken, DriverError) as reason:
                message = f"the head is not moved: its present pose is not known: {reason}"
                raise SubjectLost(message) from None
            free = head.judge.free_span(at(first))
            if free is None:
                raise SubjectLost("the head is not moved: it is in a keep-out, or too near to one")
            trial.box_rad = (
                box(first.pan_rad, free.pan_rad, reach_rad),
                box(first.tilt_rad, free.tilt_rad, reach_rad),
            )
        yield trial


def _hardware(config: pytest.Config) -> tuple[HardwareSettings, Bounds | None]:
    """What the command line names, and what bounds its moves. Raises BadFile, UsageError.

    The options of a simulated device are the section ``simulation``, over that of the packaged rover.
    """
    option = config.option
    if option.rig is not None:
        rig = load_config(Path(option.rig))
        return rig.hardware, bounds_of(rig)
    try:
        driver_options = dict(**json.loads(option.options))
    except (ValueError, TypeError) as error:
        raise pytest.UsageError(f"--options: a JSON object is expected: {error}") from None
    driver = option.head or option.camera
    simulated = is_hardware("simulated", "head", driver)
    device = DeviceSettings(driver, {} if simulated else driver_options)
    cameras = {} if option.head else {SIMULATED_CAMERA if simulated else "camera": device}
    if simulated:
        packaged = load_config(None).hardware
        simulation = {**packaged.simulation, **driver_options}
        return replace(packaged, cameras=cameras, simulation=simulation, pan_tilt=device), None
    return HardwareSettings(device if option.head else DeviceSettings("none"), cameras), None


@contextmanager
def _refusals() -> Iterator[None]:
    """End the run in one sentence where a device cannot be opened."""
    try:
        yield
    except (MastctlError, DriverError, SubjectLost) as error:
        pytest.exit(str(error), returncode=1)


def _may_move(config: pytest.Config) -> bool:
    return bool(config.option.motion) or is_hardware("simulated", "head", config.option.head or "")


def _own_limits(config: pytest.Config) -> tuple[Angles, Angles] | None:
    """The driver's own ends of pan and tilt."""
    ends = config.option.limits
    return None if ends is None else ((ends[0], ends[1]), (ends[2], ends[3]))


def _stop(trial: HeadTrial) -> None:
    """Stop the head; fail the run if that was not confirmed."""
    try:
        beside(trial.head.stop).result(STOPS_WITHIN_S)
    except Exception as error:
        message = f"the stop at the end failed, the head may still move: {type(error).__name__}: {error}"
        log.error("%s", message)
        pytest.fail(message, pytrace=False)
