"""The options of the driver ``v4l2`` in a configuration, read strictly."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from drivers.faults import nearest
from drivers.options import OptionReader
from drivers.pixels import FORMATS
from drivers.v4l2.controls import Value
from drivers.v4l2.exposure import AutoExposureSettings
from drivers.v4l2.find import Address, check_address

OPTIONS = (
    "device", "card", "bus", "format", "size_px", "rate_hz", "colour", "controls", "exposure_s", "gain",
    "white_balance_k", "focus", "auto_exposure", "margin_s", "trigger", "buffers",
)  # fmt: skip
AUTO_EXPOSURE_OPTIONS = ("group", "shortest_s", "longest_s")


@dataclass(frozen=True)
class CameraOptions:
    """How one camera is to be opened.

    Attributes
    ----------
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
    auto_exposure: AutoExposureSettings | None = None
    margin_s: float = 0.002
    trigger: str = ""
    buffers: int = 16


def parse_options(options: Mapping[str, Any], name: str) -> CameraOptions:
    """Read a camera's options.

    Raises BadOptions naming the camera, the option, its value and what is expected.
    """
    read = OptionReader(options, OPTIONS, device=name)
    device, card, bus = (read.text(key, "a text", "") for key in ("device", "card", "bus"))
    if device and (card or bus):
        raise read.refused("device", " stands beside card or bus; one or the other is expected")
    address = Address(Path(device) if device else None, card, bus)
    check_address(address, name)
    default = CameraOptions(address)
    code = read.text("format", "a text", default.format)
    if code not in FORMATS:
        raise read.refused("format", f" is {code!r}, which this driver does not read{nearest(code, FORMATS)}")
    rate_hz = None  # null: it stays as it is
    if options.get("rate_hz", 0) is not None:
        rate_hz = read.number("rate_hz", default.rate_hz, 0.1, 1000.0)
    exposure_s = read.number("exposure_s", None, 1e-5, 10.0)
    read.check_in_frame("exposure_s", exposure_s, rate_hz)
    auto = _auto_exposure(read, rate_hz)
    if auto is not None and exposure_s is None:
        raise read.refused("auto_exposure", " needs exposure_s: the exposure time to begin with")
    return CameraOptions(
        address=address,
        format=code,
        size_px=read.wholes("size_px", 2, 1, 16384) or default.size_px,
        rate_hz=rate_hz,
        colour=read.flag("colour", default.colour),
        controls=_controls(read),
        exposure_s=exposure_s,
        gain=read.whole("gain", None, -(2**31), 2**31 - 1),
        white_balance_k=read.whole("white_balance_k", None, 1000, 20000),
        focus=read.whole("focus", None, -(2**31), 2**31 - 1),
        auto_exposure=auto,
        margin_s=read.number("margin_s", default.margin_s, 0.0, 1.0),
        trigger=read.text("trigger", "a text", default.trigger),
        buffers=read.whole("buffers", default.buffers, 3, 32),
    )


def _auto_exposure(options: OptionReader, rate_hz: float | None) -> AutoExposureSettings | None:
    """The section ``auto_exposure``: true, or its settings."""
    value = options.values.get("auto_exposure", False)
    if value is False:
        return None
    default = AutoExposureSettings()
    if rate_hz is not None:
        default = replace(default, longest_s=min(default.longest_s, 1 / rate_hz))
    if value is True:
        return default
    read = options.section("auto_exposure", "true, false or its settings", AUTO_EXPOSURE_OPTIONS)
    settings = AutoExposureSettings(
        group=read.text("group", "a text", default.group),
        shortest_s=read.number("shortest_s", default.shortest_s, 1e-5, 10.0),
        longest_s=read.number("longest_s", default.longest_s, 1e-5, 10.0),
    )
    read.check_in_frame("longest_s", settings.longest_s, rate_hz)
    if settings.shortest_s >= settings.longest_s:
        words = f" is {settings.shortest_s:g} s, expected less than longest_s ({settings.longest_s:g} s)"
        raise read.refused("shortest_s", words)
    return settings


def _controls(read: OptionReader) -> dict[str, Value]:
    """The option ``controls``."""
    value = read.values.get("controls", {})
    if not isinstance(value, Mapping) or not all(
        isinstance(name, str) and isinstance(setting, int | str) for name, setting in value.items()
    ):
        raise read.bad("controls", "names of controls with whole numbers, true, false or menu entries")
    return dict(value)
