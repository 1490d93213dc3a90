"""The options of the driver ``v4l2`` in a configuration, read strictly."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeVar

from drivers.errors import BadOptions
from drivers.faults import nearest
from drivers.options import is_number, is_whole
from drivers.v4l2.controls import Value
from drivers.v4l2.exposure import ExposureSettings
from drivers.v4l2.find import Address, check_address
from drivers.v4l2.pixels import FORMATS

T = TypeVar("T")

OPTIONS = (
    "device", "card", "bus", "format", "size_px", "rate_hz", "colour", "controls", "exposure_s", "gain",
    "white_balance_k", "focus", "auto_exposure", "margin_s", "trigger", "buffers",
)  # fmt: skip
AUTO_EXPOSURE_OPTIONS = ("group", "percentile", "target", "tolerance", "shortest_s", "longest_s")


@dataclass(frozen=True)
class CameraOptions:
    """How one camera is to be opened.

    Attributes
    ----------
    address
        Which camera.
    format, size_px, rate_hz
        What is asked of it; a rate of None (null) stays as it is. The answer is checked against them.
    colour
        Whether frames are BGR; grey otherwise.
    controls
        Controls by name, in the device's own units, set in this order before the ones below.
    exposure_s, gain, white_balance_k, focus
        Fixed exposure time, gain, colour temperature and focus, each with its automatic turned off; None
        leaves it alone. The last three in the device's own units (white balance: kelvin).
    auto_exposure
        The program's own automatic exposure between measurements; None for a fixed one.
    margin_s
        How much earlier than its stamp says an exposure may have begun, seconds.
    trigger
        The name of the hardware trigger that exposes it, the same for all cameras on it; empty: none.
    buffers
        How many frames the kernel may hold while this process is held up.
    """

    address: Address
    format: str = "YUYV"
    size_px: tuple[int, int] = (640, 480)
    rate_hz: float | None = 30.0
    colour: bool = False
    controls: Mapping[str, Value] = field(default_factory=dict)
    exposure_s: float | None = None
    gain: int | None = None
    white_balance_k: int | None = None
    focus: int | None = None
    auto_exposure: ExposureSettings | None = None
    margin_s: float = 0.002
    trigger: str = ""
    buffers: int = 16


def parse_options(options: Mapping[str, Any], name: str) -> CameraOptions:
    """Read a camera's options.

    Raises
    ------
    BadOptions
        Naming the camera, the option, its value and what is expected.
    """
    for key in options:
        if key not in OPTIONS:
            raise BadOptions(f"driver 'v4l2' has no option {key!r}{nearest(str(key), OPTIONS)}", device=name)
    read = _Reader(options, name)
    device = read.text("device")
    address = Address(Path(device) if device else None, read.text("card"), read.text("bus"))
    if address.link is not None and (address.card or address.bus):
        raise BadOptions("'device' stands beside 'card' or 'bus'; one or the other is expected", device=name)
    check_address(address, name)
    code = read.text("format") or CameraOptions.format
    if code not in FORMATS:
        raise BadOptions(
            f"'format' is {code!r}, which this driver does not read{nearest(code, FORMATS)}", device=name
        )
    rate_hz = None if options.get("rate_hz", 0) is None else _rate(read)
    auto = _auto_exposure(read, name, rate_hz)
    exposure_s = read.number("exposure_s", 1e-5, 10.0)
    _check_in_frame("exposure_s", exposure_s, rate_hz, name)
    if auto is not None and exposure_s is None:
        raise BadOptions("'auto_exposure' needs 'exposure_s': the exposure time to begin with", device=name)
    return CameraOptions(
        address=address,
        format=code,
        size_px=read.size("size_px") or CameraOptions.size_px,
        rate_hz=rate_hz,
        colour=read.flag("colour"),
        controls=read.controls("controls"),
        exposure_s=exposure_s,
        gain=read.whole("gain", -(2**31), 2**31 - 1),
        white_balance_k=read.whole("white_balance_k", 1000, 20000),
        focus=read.whole("focus", -(2**31), 2**31 - 1),
        auto_exposure=auto,
        margin_s=_or(read.number("margin_s", 0.0, 1.0), CameraOptions.margin_s),
        trigger=read.text("trigger"),
        buffers=_or(read.whole("buffers", 3, 32), CameraOptions.buffers),
    )


def _rate(read: _Reader) -> float | None:
    return read.number("rate_hz", 0.1, 1000.0) or CameraOptions.rate_hz


def _or(value: T | None, default: T) -> T:
    return default if value is None else value


def _check_in_frame(option: str, exposure_s: float | None, rate_hz: float | None, name: str) -> None:
    """Refuse an exposure time for which a camera would have to stretch its frames. Raises BadOptions."""
    if exposure_s is not None and rate_hz is not None and exposure_s > 1 / rate_hz:
        raise BadOptions(
            f"{option!r} is {exposure_s:g} s, longer than a frame at 'rate_hz' {rate_hz:g} "
            f"({1 / rate_hz:.4g} s); a shorter one, or a lower rate, is expected",
            device=name,
        )


def _auto_exposure(read: _Reader, name: str, rate_hz: float | None) -> ExposureSettings | None:
    """The section ``auto_exposure``: true, or its settings."""
    value = read.options.get("auto_exposure", False)
    if value is False:
        return None
    if value is True:
        value = {}
    if not isinstance(value, Mapping):
        raise BadOptions(
            f"'auto_exposure' is {value!r} where true, false or its settings are expected", device=name
        )
    for key in value:
        if key not in AUTO_EXPOSURE_OPTIONS:
            near = nearest(str(key), AUTO_EXPOSURE_OPTIONS)
            raise BadOptions(f"'auto_exposure' has no setting {key!r}{near}", device=name)
    inner = _Reader(value, name, "auto_exposure.")
    default = ExposureSettings()
    longest_s = default.longest_s if rate_hz is None else min(default.longest_s, 1 / rate_hz)
    settings = ExposureSettings(
        group=inner.text("group"),
        percentile=_or(inner.number("percentile", 1.0, 99.9), default.percentile),
        target=_or(inner.number("target", 10.0, 245.0), default.target),
        tolerance=_or(inner.number("tolerance", 1.0, 100.0), default.tolerance),
        shortest_s=_or(inner.number("shortest_s", 1e-5, 10.0), default.shortest_s),
        longest_s=_or(inner.number("longest_s", 1e-5, 10.0), longest_s),
    )
    _check_in_frame("auto_exposure.longest_s", settings.longest_s, rate_hz, name)
    if settings.shortest_s >= settings.longest_s:
        raise BadOptions(
            f"'auto_exposure.shortest_s' is {settings.shortest_s:g} s, which is not below "
            f"'longest_s' ({settings.longest_s:g} s)",
            device=name,
        )
    return settings


class _Reader:
    """Takes values out of the options, each of its type and within its bounds."""

    def __init__(self, options: Mapping[str, Any], name: str, prefix: str = "") -> None:
        self.options = options
        self._name = name
        self._prefix = prefix

    def text(self, key: str) -> str:
        value = self.options.get(key, "")
        if not isinstance(value, str) or (key in self.options and not value):
            raise self._bad(key, "a text")
        return value

    def flag(self, key: str) -> bool:
        value = self.options.get(key, False)
        if not isinstance(value, bool):
            raise self._bad(key, "true or false")
        return value

    def number(self, key: str, least: float, most: float) -> float | None:
        value = self.options.get(key)
        if key not in self.options:
            return None
        if not is_number(value) or not least <= value <= most:
            raise self._bad(key, f"a number {least:g} to {most:g}")
        return float(value)

    def whole(self, key: str, least: int, most: int) -> int | None:
        if key not in self.options:
            return None
        value = self.options[key]
        if not is_whole(value) or not least <= value <= most:
            raise self._bad(key, f"a whole number {least} to {most}")
        return value

    def size(self, key: str) -> tuple[int, int] | None:
        if key not in self.options:
            return None
        value = self.options[key]
        whole = isinstance(value, (list, tuple)) and all(is_whole(v) and 0 < v <= 16384 for v in value)
        if not whole or len(value) != 2:
            raise self._bad(key, "[width, height] in pixels")
        return int(value[0]), int(value[1])

    def controls(self, key: str) -> dict[str, Value]:
        value = self.options.get(key, {})
        good = isinstance(value, Mapping) and all(
            isinstance(k, str) and isinstance(v, (int, str)) for k, v in value.items()
        )
        if not good:
            raise self._bad(key, "names of controls with whole numbers, true, false or menu entries")
        return dict(value)

    def _bad(self, key: str, expected: str) -> BadOptions:
        value = self.options.get(key)
        return BadOptions(
            f"{self._prefix + key!r} is {value!r} where {expected} is expected", device=self._name
        )
