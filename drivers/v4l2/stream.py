"""One opened and streaming camera: what was requested, what the camera answered, and what it lacks."""

from __future__ import annotations

import logging
from collections.abc import Sequence

from calib.geometry.mode import SensorMode
from drivers.clock import Clock
from drivers.errors import DriverError, NoCamera, UnsupportedFormat
from drivers.pixels import FORMATS, PictureFormat
from drivers.v4l2 import abi, find
from drivers.v4l2.controls import (
    CameraControl,
    ControlProblem,
    first_of,
    get_value,
    list_controls,
    set_by_name,
    set_value,
)
from drivers.v4l2.node import Node
from drivers.v4l2.settings import EXPOSURE, EXPOSURE_UNIT_S, MEANINGS, CameraOptions, value_of
from drivers.v4l2.stamps import StampRule
from drivers.values_set import ValuesSet

log = logging.getLogger(__name__)

RATE_TOLERANCE = 0.02  # 30 Hz is often 30000/1001
UNKNOWN_RATE_HZ = 5.0  # a period longer than any that a camera without a rate is likely to have


class Stream:
    """A camera with its format, rate and controls set, streaming. Closing it gives everything back.

    ``rate_known``: the camera itself reports its rate; else it is the requested one. ``exposure_s`` is by the
    camera's own statement, None if unknown: also where its automatic stayed on. ``requested_exposure_s`` was
    set last, before the camera rounded it. Raises UnsupportedFormat if format, size or rate are not to be
    had, the message says what is; and for an exposure longer than a frame, for which a camera stretches its
    frames; DriverError if the camera cannot be opened or does not start.
    """

    def __init__(
        self, options: CameraOptions, name: str, clock: Clock, exposure_s: float | None = None
    ) -> None:
        self._options = options
        self._name = name
        self._clock = clock
        self.exposure_s: float | None = None
        self.requested_exposure_s: float | None = None
        self.problems: list[ControlProblem] = []
        self.in_force = {EXPOSURE.name: ValuesSet(None)}
        self._exposure: CameraControl | None = None
        self._automatic_stays = False
        self.node = find.open_node(options.address, name)
        try:
            self.format = set_format(self.node, options.format, options.size_px, name)
            self.rate_hz, self.rate_known = _set_rate(self.node, options, name)
            self.period_s = 1 / self.rate_hz
            self.rule = StampRule(options.margin_s, self.node.identity.driver)
            exposure_s = options.exposure_s if exposure_s is None else exposure_s
            self._check_exposure(exposure_s, "'exposure_s' is")
            if options.auto_exposure is not None:
                self._check_exposure(options.auto_exposure.longest_s, "'auto_exposure.longest_s' is")
            self._set_controls(options, exposure_s)
            self._check_exposure(self.exposure_s, "the camera has an exposure of")
            self.sensor_mode = sensor_mode_of(self.node, self.format.size_px)
            self.node.start(options.buffers)
        except BaseException:
            self.node.close()
            raise

    def set_exposure(self, exposure_s: float) -> None:
        """Set the exposure time; `exposure_s` is then what the camera made of it. Raises DriverError."""
        self.requested_exposure_s = exposure_s
        if self._exposure is None:
            return
        steps = max(1, round(exposure_s / EXPOSURE_UNIT_S))
        bounded = min(max(steps, self._exposure.minimum), self._exposure.maximum)
        began_s = self._clock.now_s()
        if problem := set_value(self.node, self._exposure, bounded):
            log.warning("%s: %s", self._name, problem.message)
        became = get_value(self.node, self._exposure)
        known = became is not None and not self._automatic_stays
        self.exposure_s = became * EXPOSURE_UNIT_S if became is not None and known else None
        self.in_force[EXPOSURE.name].change(self.exposure_s, began_s, self._clock.now_s())

    def _check_exposure(self, exposure_s: float | None, message: str) -> None:
        """Refuse an exposure time that is longer than a frame. Raises UnsupportedFormat."""
        if self.rate_known and exposure_s is not None and exposure_s > self.period_s * (1 + RATE_TOLERANCE):
            raise UnsupportedFormat(
                f"{message} {exposure_s:g} s, longer than a frame at the camera's {self.rate_hz:g} Hz "
                f"({self.period_s:.4g} s); a shorter one, or a lower rate, is expected",
                device=self._name,
            )

    def close(self) -> None:
        """Stop and let go; never raises for a camera that is gone."""
        self.node.close()

    def _set_controls(self, options: CameraOptions, exposure_s: float | None) -> None:
        """Set the named controls, then those that go by meaning; keep a problem for each that is missing."""
        self.problems += set_by_name(self.node, options.controls)
        controls = list_controls(self.node)
        if exposure_s is not None:
            self._automatic_stays = not self._turn_off(controls, EXPOSURE.automatic, EXPOSURE.off)
            self._turn_off(controls, abi.CID_EXPOSURE_AUTO_PRIORITY, 0)
            self._exposure = first_of(controls, (EXPOSURE.control,))
            if self._exposure is None:
                self._missing("exposure", "exposure_s")
            self.set_exposure(exposure_s)
        for one in MEANINGS[1:]:
            control, value = first_of(controls, (one.control,)), getattr(options, one.name)
            began_s = self._clock.now_s()
            if value is not None:
                self._turn_off(controls, one.automatic, one.off)
                if control is None:
                    self._missing(one.word, one.word)
                elif problem := set_value(self.node, control, value):
                    self.problems.append(problem)
            if control is not None:
                now = value_of(self.node, controls, one)
                self.in_force[one.name] = ValuesSet(now if value is None else None)
                if value is not None:
                    self.in_force[one.name].change(now, began_s, self._clock.now_s())
        for problem in self.problems:
            log.warning("%s: %s", self._name, problem.message)

    def _turn_off(self, controls: Sequence[CameraControl], which: int, value: int) -> bool:
        """Turn an automatic off, where the camera has one; return whether none stays on."""
        if (control := first_of(controls, (which,))) and (problem := set_value(self.node, control, value)):
            self.problems.append(problem)
            return False
        return True

    def _missing(self, word: str, option: str) -> None:
        self.problems.append(
            ControlProblem(option, f"the camera has no control for {word}; it stays as it is")
        )


def set_format(node: Node, code: str, size_px: tuple[int, int], name: str) -> PictureFormat:
    """Set format and size and check the answer.

    Raises UnsupportedFormat if the camera answers with another one; the message says what it offers.
    """
    answer = node.set_format(code, size_px)
    if answer.code != code:
        offered = node.formats()
        read = ", ".join(f for f in offered if f in FORMATS) or "none that this driver reads"
        others = (
            f" and {rest} that this driver does not read"
            if (rest := len(set(offered) - set(FORMATS)))
            else ""
        )
        raise UnsupportedFormat(f"the camera has no format {code}; it has {read}{others}", device=name)
    if answer.size_px != size_px:
        raise UnsupportedFormat(
            f"the camera has no {size_px[0]}x{size_px[1]} in {code}; it has {sizes_text(node, code)}",
            device=name,
        )
    if answer.field not in (abi.FIELD_ANY, abi.FIELD_NONE):
        raise UnsupportedFormat(
            f"the camera's pictures are interlaced (field {answer.field}); whole pictures are needed",
            device=name,
        )
    return answer


def sensor_mode_of(node: Node, size_px: tuple[int, int]) -> SensorMode:
    """Return which pixels of the sensor pictures of ``size_px`` show.

    The crop counts from the native size's corner, or that of the crop bounds where there is no native size.
    It is unknown of a driver without cropping, and where pictures are composed into a part of the buffer.
    """
    controls = list_controls(node)
    flips = (first_of(controls, (control,)) for control in (abi.CID_HFLIP, abi.CID_VFLIP))
    horizontal, vertical = (one is not None and bool(get_value(node, one)) for one in flips)
    try:
        crop = node.selection(abi.SEL_TGT_CROP)
        whole = node.selection(abi.SEL_TGT_NATIVE_SIZE) or node.selection(abi.SEL_TGT_CROP_BOUNDS)
        composed = node.selection(abi.SEL_TGT_COMPOSE) or (0, 0, *size_px)
    except NoCamera:
        raise
    except DriverError as error:
        log.info("%s: its driver does not report its crop: %s", node.path, error)
        return SensorMode(size_px, flip=(horizontal, vertical))
    if crop is not None and whole is not None and composed == (0, 0, *size_px):
        x, y = crop[0] - whole[0], crop[1] - whole[1]
        try:
            return SensorMode(size_px, (x, y, *crop[2:]), whole[2:], (horizontal, vertical))
        except ValueError as error:
            log.info("%s: the crop that its driver reports cannot be: %s", node.path, error)
    return SensorMode(size_px, flip=(horizontal, vertical))


def sizes_text(node: Node, code: str) -> str:
    """Return the sizes of a format, as text."""
    sizes, steps = node.sizes(code)
    if steps is not None:
        least_w, most_w, step_w, least_h, most_h, step_h = steps
        return f"{least_w}x{least_h} to {most_w}x{most_h} in steps of {step_w} and {step_h}"
    return ", ".join(f"{w}x{h}" for w, h in sizes) or "only what is set"


def _set_rate(node: Node, options: CameraOptions, name: str) -> tuple[float, bool]:
    """Set the rate, and check the answer if one was requested; return whether there was one, too."""
    if options.rate_hz is None:
        rate_hz = node.current_rate()
        return rate_hz or UNKNOWN_RATE_HZ, bool(rate_hz)
    answer = node.set_rate(options.rate_hz)
    if answer is None:  # no say in it: an industrial camera with a fixed rate, or a trigger
        log.warning("%s: the camera does not take a frame rate", name)
        return options.rate_hz, False
    if abs(answer - options.rate_hz) > RATE_TOLERANCE * options.rate_hz:
        offered = ", ".join(f"{rate:g}" for rate in node.rates_hz(options.format, options.size_px))
        width, height = options.size_px
        raise UnsupportedFormat(
            f"the camera has no rate of {options.rate_hz:g} Hz at {width}x{height} in {options.format}; "
            f"it has {offered or f'{answer:g}'} Hz",
            device=name,
        )
    return answer, True
