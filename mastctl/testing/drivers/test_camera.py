"""What a camera driver promises (docs/drivers.md), tested on any camera."""

from __future__ import annotations

import logging
import math
import time

from drivers.errors import DriverError
from drivers.interfaces import Camera, CameraSetting
from mastctl.conform.device_checks import (
    FRAME_TIMEOUT_S,
    GRACE_S,
    CameraTrial,
    NotTried,
    PromiseBroken,
    beside,
    call,
    ended,
    expect,
)

log = logging.getLogger(__name__)

CLOSES_WITHIN_S = 3.0
WAITS_S = 6.0  # longer than a close may take, shorter than a call is waited for
FRAMES_EACH = 5
SETTING_FRAMES = 20  # so many may be of unknown settings after a change
SETTING_PART = 0.05  # of its value a setting is changed by, one step at least
ROUNDING = 1e-6


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
    driver, tried = camera.driver, []
    for one in call("settings()", driver.settings):
        other = _value_beside(one)
        if other is None or one.value is None:
            continue
        try:
            now = _changed(driver, one.name, other)
            values = ((camera.frame().settings or {}).get(one.name) for _ in range(SETTING_FRAMES))
            seen = next((value for value in values if value is not None), None)
            after = f"exposed after {one.name} was set to {now:.6g}"
            if seen is None:
                raise PromiseBroken(f"none of {SETTING_FRAMES} frames {after} has its value")
            expect(math.isclose(seen, now, rel_tol=ROUNDING), f"a frame {after} has {seen:.6g}")
        finally:
            _changed(driver, one.name, one.value)
        tried.append(one.name)
    if not tried:
        raise NotTried("it has no setting but focus that can be changed now")
    log.info(", ".join(tried))


def _value_beside(one: CameraSetting) -> float | None:
    """A value beside the present one; None for what is not tried.

    A focus is left alone: its motor may not come back to the calibrated place.
    """
    if one.name == "focus" or one.value is None or one.automatic or one.refusal:
        return None
    by = max(one.step, SETTING_PART * abs(one.value)) or SETTING_PART * (one.maximum - one.minimum)
    if one.step:
        by = math.floor(by / one.step + ROUNDING) * one.step
    return one.value + by if one.value + by <= one.maximum else max(one.value - by, one.minimum)


def _changed(driver: Camera, name: str, value: float) -> float:
    """Set a value, and return the one that is read back."""
    notes = call("adjust()", lambda: driver.adjust({name: value}))
    now = next((one.value for one in call("settings()", driver.settings) if one.name == name), None)
    if now is None:
        raise PromiseBroken(f"{name} is not known after it was set to {value:.6g}")
    message = f"{name} is {now:.6g} where {value:.6g} was set, and no note says so"
    expect(math.isclose(now, value, rel_tol=ROUNDING) or notes, message)
    return now


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
