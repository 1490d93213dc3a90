"""The options of the driver ``aravis`` in a configuration, read strictly."""

from __future__ import annotations

import ipaddress
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

from drivers.faults import nearest
from drivers.options import OptionReader, is_number
from drivers.pixels import GENICAM

OPTIONS = (
    "serial", "address", "id", "format", "size_px", "offset_px", "rate_hz", "colour", "features",
    "exposure_s", "gain", "trigger_source", "trigger", "stamp", "margin_s", "buffers",
)  # fmt: skip
Stamped = Literal["start", "end", "either"]


@dataclass(frozen=True)
class AravisOptions:
    """How one camera is to be opened.

    Attributes
    ----------
    serial, address, id
        Which camera: by its serial number, its IP address (GigE Vision) or the name that Aravis lists.
    format, size_px, offset_px, rate_hz
        Requested of it; a rate of None (null) stays as it is. The answer is checked against them.
    colour
        Whether frames are BGR; grey otherwise.
    features
        The camera's own features by their GenICam names, set in this order before all else.
    exposure_s, gain
        Fixed exposure time, and gain in the camera's own unit, each with its automatic turned off; None
        leaves it alone.
    trigger_source
        Empty: free-running. Else the input line whose rising edge exposes a frame, by its GenICam name.
    trigger
        The name of the hardware trigger that exposes it, the same for all cameras on it; empty: none.
    stamp
        Whether the camera stamps the start or the end of an exposure; either: it is not known.
    margin_s
        How much later than the end of its exposure the first packet of a frame may come at best, seconds: for
        cameras whose clock cannot be read.
    buffers
        How many frames may lie here while this process is held up.
    """

    serial: str = ""
    address: str = ""
    id: str = ""
    format: str = "Mono8"
    size_px: tuple[int, int] = (640, 480)
    offset_px: tuple[int, int] = (0, 0)
    rate_hz: float | None = 30.0
    colour: bool = False
    features: Mapping[str, Any] = field(default_factory=dict)
    exposure_s: float | None = None
    gain: float | None = None
    trigger_source: str = ""
    trigger: str = ""
    stamp: Stamped = "either"
    margin_s: float = 0.01
    buffers: int = 8

    @property
    def free_running(self) -> bool:
        """Whether the camera exposes frames by itself."""
        return not self.trigger_source

    @property
    def words(self) -> str:
        """Which camera, for people."""
        named = (("serial number", self.serial), ("address", self.address), ("id", self.id))
        return " and ".join(f"{what} {value}" for what, value in named if value)


def parse_options(options: Mapping[str, Any], name: str) -> AravisOptions:
    """Read a camera's options.

    Raises BadOptions naming the camera, the option, its value and what is expected.
    """
    read = OptionReader(options, OPTIONS, device=name)
    usual = AravisOptions()
    serial, address, identity = (read.text(key, "a text", "") for key in ("serial", "address", "id"))
    if not (serial or address or identity):
        raise read.refused("serial", ", address or id is expected: which camera it is")
    if address:
        _check_address(read, address)
    code = read.text("format", "a text", usual.format)
    if code not in GENICAM:
        raise read.refused("format", f" is {code!r}, which this driver does not read{nearest(code, GENICAM)}")
    rate_hz = None
    source = read.text("trigger_source", "a text", usual.trigger_source)
    if source == "Software":
        raise read.bad("trigger_source", "an input line, such as Line1: a request exposes no frame")
    if options.get("rate_hz", 0) is not None and not source:
        rate_hz = read.number("rate_hz", usual.rate_hz, 0.1, 1000.0)
    elif source and options.get("rate_hz") is not None:
        raise read.refused(
            "rate_hz", " stands beside trigger_source; a triggered camera has no rate of its own"
        )
    exposure_s = read.number("exposure_s", None, 1e-6, 10.0)
    read.check_in_frame("exposure_s", exposure_s, rate_hz)
    stamp: Stamped = read.one_of("stamp", usual.stamp, ("start", "end", "either"))
    return AravisOptions(
        serial=serial,
        address=address,
        id=identity,
        format=code,
        size_px=read.wholes("size_px", 2, 1, 32768) or usual.size_px,
        offset_px=read.wholes("offset_px", 2, 0, 32768) or usual.offset_px,
        rate_hz=rate_hz,
        colour=read.flag("colour", usual.colour),
        features=_features(read),
        exposure_s=exposure_s,
        gain=read.number("gain", None, -1000.0, 1e6),
        trigger_source=source,
        trigger=read.text("trigger", "a text", usual.trigger),
        stamp=stamp,
        margin_s=read.number("margin_s", usual.margin_s, 0.0, 1.0),
        buffers=read.whole("buffers", usual.buffers, 3, 64),
    )


def _check_address(read: OptionReader, address: str) -> None:
    """Refuse what is no IP address. Raises BadOptions."""
    try:
        ipaddress.IPv4Address(address)
    except ValueError:
        raise read.bad("address", "an IPv4 address, such as 192.168.0.20") from None


def _features(read: OptionReader) -> dict[str, Any]:
    """The option ``features``."""
    value = read.values.get("features", {})
    if not isinstance(value, Mapping) or not all(
        isinstance(name, str)
        and name.isidentifier()
        and (is_number(setting) or isinstance(setting, str | bool))
        for name, setting in value.items()
    ):
        raise read.bad("features", "GenICam names with numbers, texts, true or false")
    return dict(value)
