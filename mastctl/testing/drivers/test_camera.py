"""What a camera driver promises (docs/drivers.md), tested on any camera."""

from __future__ import annotations

import logging
import time

from drivers.errors import DriverError
from mastctl.conform.device_checks import (
    FRAME_TIMEOUT_S,
    GRACE_S,
    CameraTrial,
    PromiseBroken,
    beside,
    call,
    ended,
    expect,
    settings_tried,
)

log = logging.getLogger(__name__)

CLOSES_WITHIN_S = 3.0
WAITS_S = 6.0  # longer than a close may take, shorter than a call is waited for
FRAMES_EACH = 5


def test_frames(camera: CameraTrial) -> None:
    """Frames come, of the right kind and size, none dark, none from the future."""
    summary = camera.kept("frames")
    rate = "" if summary["rate_hz"] is None else f", {summary['rate_hz']:.2f} Hz"
    width, height = summary["size_px"]
    log.info(f"{summary['frames']} frames of {width}x{height} px{rate}")


def test_fresh(camera: CameraTrial) -> None:
    """No frame comes whose exposure began before the requested moment."""
    low, median, high = (1e3 * delay_s for delay_s in camera.kept("fresh")["delay_s"])
    log.info(f"from the exposure's end to arrival {low:.1f} to {high:.1f} ms, median {median:.1f} ms")


def test_order(camera: CameraTrial) -> None:
    """Counts and times of frames grow together."""
    log.info(f"{camera.kept('order')['missed']} passed over")


def test_refusal(camera: CameraTrial) -> None:
    """A frame that cannot come in time is refused in time, with NoFreshFrame."""
    camera.kept("refusal")


def test_stated(camera: CameraTrial) -> None:
    """Size and pace, where it states them, are those of its frames."""
    log.info(", ".join(camera.kept("stated")["abilities"]) or "it states nothing")


def test_threads(camera: CameraTrial) -> None:
    """Two threads at once both get fresh frames."""

    def work() -> None:
        for _ in range(FRAMES_EACH):
            camera.frame()

    for one in [beside(work) for _ in range(2)]:
        try:
            ended("next_frame() beside another", one, FRAMES_EACH * (FRAME_TIMEOUT_S + GRACE_S))
        except DriverError as error:
            raise PromiseBroken(f"next_frame() beside another: {error}") from None


def test_settings(camera: CameraTrial) -> None:
    """A setting that is changed by a little is read back, on new frames, and put back."""
    driver = camera.driver
    tried = settings_tried(
        lambda: call("settings()", driver.settings),
        lambda name, value: call("adjust()", lambda: driver.adjust({name: value})),
        lambda: camera.frame().settings,
    )
    log.info(tried)


def test_close(camera: CameraTrial) -> None:
    """Close ends a call that waits, twice does no harm, and then no frame comes."""
    driver = camera.driver
    waits = beside(lambda: driver.next_frame(time.monotonic() + 60.0, WAITS_S))
    time.sleep(0.1)
    began_s = time.monotonic()
    for name in ("close()", "a second close()"):
        try:
            call(name, driver.close)
        except DriverError as error:
            raise PromiseBroken(f"{name} raised {type(error).__name__}: {error}") from None
    try:
        ended("next_frame() of a closed camera", waits)
        raise PromiseBroken("a frame that cannot have been exposed yet came when the camera was closed")
    except DriverError:
        took_s = time.monotonic() - began_s
    expect(took_s < CLOSES_WITHIN_S, f"close, and the call that waited, took {took_s:.1f} s")
    try:
        call("next_frame() of a closed camera", lambda: driver.next_frame(time.monotonic(), 1.0))
    except DriverError:
        pass
    else:
        raise PromiseBroken("a closed camera gave a frame")
    if camera.open_again is not None:
        camera.driver = camera.open_again()
        camera.frame()
        log.info(f"within {took_s:.2f} s, and opened again")
