"""The configuration of one daemon (docs/reference/configuration.md), read strictly.

The file by itself is checked when it is read; its cameras and pairs are checked when the mast file is read
(`check_cameras`). Options of drivers are handed through unchanged; the drivers judge them.
"""

from __future__ import annotations

import ipaddress
import math
import os
import re
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal
from urllib.parse import quote, urlsplit

from pydantic import AfterValidator, BeforeValidator, ConfigDict, Field, WithJsonSchema, model_validator

from calib.errors import BadFile
from calib.files import read_bytes
from calib.files.records import ABSENT, Free, PathInFile, Record, Text, parse_record, problem, read_record
from calib.files.yaml_text import kind_of, nearest, parse_mapping
from calib.geometry.rig import Rig
from drivers.faults import PAN_TILT
from drivers.frame_times import MOST_OFFSET_S
from drivers.hardware import DeviceSettings, HardwareSettings, is_hardware
from drivers.registry import Kind
from mastctl.devices.judge import LEAST_CONE_RAD, SUN, WIDEST_CONE_RAD, Limits, SunDirection, direction_of
from mastctl.devices.keep_out import Box
from mastctl.motion.pairs import TrackingSettings
from mastctl.packaged import default_config
from mastctl.recorder.folder import RecordSettings

CONFIG_SCHEMA = "mastctl/config/1"
DEFAULT_HOST = "127.0.0.1"
DEFAULT_PORT = 8420

_MAX_BYTES = 1_000_000
_FULL_TURN_RAD = 6.2832
HOST_NAME = re.compile(r"[A-Za-z0-9]([A-Za-z0-9._-]{0,252})|[0-9A-Fa-f:]*:[0-9A-Fa-f:.]*")
LONGEST_SOCKET_PATH = 100  # bytes; the kernel's own bound is 108


def _short(socket: Path) -> Path:
    if len(os.fsencode(socket)) > LONGEST_SOCKET_PATH:
        raise problem("", f"{socket} is longer than {LONGEST_SOCKET_PATH} bytes")
    return socket


def _host_name(name: str) -> str:
    if not HOST_NAME.fullmatch(name):
        raise problem("", f"'{name[:60]}' where a name without scheme and port is expected")
    return name.lower()


_Socket = Annotated[
    PathInFile,
    AfterValidator(_short),
    WithJsonSchema({"type": "string", "pattern": r"\S", "maxLength": LONGEST_SOCKET_PATH}),
]
_Host = Annotated[
    str, AfterValidator(_host_name), WithJsonSchema({"type": "string", "pattern": f"^({HOST_NAME.pattern})$"})
]
_ONE_OR_THE_OTHER = {"dependentSchemas": {"socket": {"properties": {"host": False, "port": False}}}}


class Listen(Record, json_schema_extra=_ONE_OR_THE_OTHER):
    """Where the daemon listens, and to which names it answers: in lower case, beside the loopback ones."""

    host: Text = Field(
        default=DEFAULT_HOST,
        description="where the daemon listens; at any but a loopback address it asks for a token (Access)",
    )
    port: Annotated[int, Field(ge=0, le=65535)] = Field(default=DEFAULT_PORT, description="0: any free one")
    socket: _Socket = Field(default=ABSENT, description="a Unix socket instead of host and port")
    hosts: list[_Host] = Field(
        default=[],
        description="names that the daemon answers to beside the loopback ones; with any of them it asks for "
        "a token",
    )

    @model_validator(mode="after")
    def _is_one_address(self) -> Listen:
        for other in ("host", "port"):
            if self.socket is not None and other in self.model_fields_set:
                raise problem(other, "is given beside 'socket'; one or the other is expected")
        return self

    @property
    def url(self) -> str:
        """The address as clients take it: ``http://127.0.0.1:8420`` or ``unix:/path/of/socket``.

        Of a daemon that listens at every address of the machine it is the loopback one.
        """
        if self.socket is not None:
            return f"unix:{quote(str(self.socket))}"
        host = {"0.0.0.0": "127.0.0.1", "::": "::1"}.get(self.host, self.host)
        return f"http://{f'[{host}]' if ':' in host else host}:{self.port}"

    @property
    def needs_token(self) -> bool:
        """Whether others than this machine's users may reach it, by its address or a name it answers to."""
        return bool(self.hosts) or (self.socket is None and not is_loopback(self.host))


@dataclass(frozen=True)
class Config:
    """A daemon's configuration; paths are absolute or relative to the working folder. ``data``: its bytes.

    ``repeat_after_s``: as `mastctl.motion.loop.REPEAT_AFTER_S`, None for that.
    """

    path: Path
    mast_file: Path
    listen: Listen
    hardware: HardwareSettings
    limits: Limits
    sun: SunDirection | None = None
    tracking: TrackingSettings = field(default_factory=TrackingSettings)
    repeat_after_s: float | None = None
    record: RecordSettings = field(default_factory=RecordSettings)
    data: bytes = field(default=b"", repr=False)
    state_folder: Path | None = None


def _two_ends(ends: object) -> object:
    if not isinstance(ends, list) or len(ends) != 2:
        raise problem("", f"{kind_of(ends)} where [lowest, highest] in radians is expected")
    return ends


def _ascending(ends: list[float]) -> list[float]:
    if ends[0] >= ends[1]:
        raise problem("", f"[{ends[0]:g}, {ends[1]:g}] where the lowest must be below the highest")
    return ends


def _keep_out_name(name: str) -> str:
    if not name.isidentifier() or name == SUN:
        raise problem("", f"a name of letters, digits and _ is expected, not '{SUN}'")
    return name


_Angle = Annotated[float, Field(ge=-_FULL_TURN_RAD, le=_FULL_TURN_RAD)]
_Ends = Annotated[
    list[_Angle], Field(min_length=2, max_length=2), BeforeValidator(_two_ends), AfterValidator(_ascending)
]
_KeepOutName = Annotated[
    str,
    AfterValidator(_keep_out_name),
    WithJsonSchema({"type": "string", "pattern": f"^(?!{SUN}$)[A-Za-z_][A-Za-z0-9_]*$"}),
]


class HeadDriverRecord(Record):
    """The driver of the head."""

    driver: Text = Field(
        description="a driver's name, also of an installed package, or package.module:factory (Write a "
        "driver)"
    )
    options: Free = Field(default={}, description="below, or the factory's keywords")


class _HeadAlone(Record):
    """A configuration of which only the head counts."""

    model_config = ConfigDict(extra="ignore")
    pan_tilt: HeadDriverRecord


class CameraDriverRecord(HeadDriverRecord):
    """The driver of a camera."""

    offset_s: Annotated[float, Field(ge=-MOST_OFFSET_S, le=MOST_OFFSET_S)] = Field(
        default=0.0, description="measured delay of mid-exposure after its stamps (Cameras)"
    )


class KeepOutRecord(Record):
    """A box of joint angles."""

    pan_rad: _Ends = Field(description="pan round the circle")
    tilt_rad: _Ends = Field(description="pan round the circle")

    def named(self, name: str) -> Box:
        """Return the box with its name."""
        return Box(name, (self.pan_rad[0], self.pan_rad[1]), (self.tilt_rad[0], self.tilt_rad[1]))


class SunRecord(Record):
    """A direction and a cone around it."""

    azimuth_rad: _Angle = Field(description="from x over y: north over east, forward over right")
    elevation_rad: Annotated[float, Field(ge=-math.pi / 2, le=math.pi / 2)]
    half_angle_rad: Annotated[float, Field(ge=LEAST_CONE_RAD, le=WIDEST_CONE_RAD)] = Field(
        description="of the cone"
    )
    frame: Literal["site", "rover"] = Field(default="site", description="whose x and y")

    @property
    def direction(self) -> SunDirection:
        """The direction as a vector."""
        return SunDirection(
            direction_of(self.azimuth_rad, self.elevation_rad), self.frame, self.half_angle_rad
        )


_NEEDS_MARGIN = {
    "if": {"required": ["keep_out"], "properties": {"keep_out": {"minProperties": 1}}},
    "then": {"required": ["margin_rad"], "properties": {"margin_rad": {"exclusiveMinimum": 0}}},
}
_SOFT = "soft limits: no driver is ever sent beyond them. Limits explains all of them"


class LimitsRecord(Record, json_schema_extra=_NEEDS_MARGIN):
    """The soft limits."""

    pan_rad: _Ends = Field(description=_SOFT)
    tilt_rad: _Ends = Field(description=_SOFT)
    speed_rad_per_s: Annotated[float, Field(gt=0.0, le=100.0)] = Field(description="cap of every move")
    margin_rad: Annotated[float, Field(ge=0.0, le=0.5)] = Field(
        default=0.0,
        description="kept free at the ends of both ranges, and around every keep-out; required with "
        "keep-outs",
    )
    acceleration_rad_per_s2: Annotated[float, Field(gt=0.0, le=1000.0)] = Field(
        default=ABSENT, description="a head with a higher acceleration is refused at the start"
    )
    keep_out: dict[_KeepOutName, KeepOutRecord] = Field(
        default={}, description="boxes that the head stays out of"
    )
    sun: SunRecord = Field(default=ABSENT, description="a direction that no head camera looks into")

    @model_validator(mode="after")
    def _leave_room(self) -> LimitsRecord:
        margin_rad = self.margin_rad
        for key, (low, high) in (("pan_rad", self.pan_rad), ("tilt_rad", self.tilt_rad)):
            if low + margin_rad >= high - margin_rad:
                reason = f"[{low:g}, {high:g}] leaves nothing between margins of {margin_rad:g} rad"
                raise problem(key, reason)
        if self.keep_out and margin_rad == 0.0:
            reason = "is needed beside keep_out, above 0: what the head overshoots, rings and has as backlash"
            raise problem("margin_rad", reason)
        return self

    @property
    def limits(self) -> Limits:
        """The limits with the margin left at both ends."""
        margin_rad = self.margin_rad
        (pan_low, pan_high), (tilt_low, tilt_high) = self.pan_rad, self.tilt_rad
        return Limits(
            (pan_low + margin_rad, pan_high - margin_rad),
            (tilt_low + margin_rad, tilt_high - margin_rad),
            self.speed_rad_per_s,
            margin_rad,
            self.acceleration_rad_per_s2,
            tuple(box.named(name) for name, box in self.keep_out.items()),
        )


class PointingRecord(Record):
    """How residuals are confirmed."""

    repeat_after_s: Annotated[float, Field(ge=0.0, le=60.0)] = Field(
        default=ABSENT,
        description="delay of the second image that must repeat a residual; detects images that are older "
        "than their stamps by up to that. 0: no second image (A later image repeats it)",
    )


class StateRecord(Record):
    """Where the daemon's state lies."""

    folder: PathInFile = Field(description="the daemon's persistent state")


class ConfigRecord(Record):
    """A configuration."""

    schema_: Literal["mastctl/config/1"] = Field(alias="schema")
    mast_file: PathInFile = Field(description="relative paths in a configuration start at its folder")
    pan_tilt: HeadDriverRecord = Field(description="the head")
    limits: LimitsRecord
    cameras: dict[str, CameraDriverRecord] = Field(
        default={},
        description="cameras by name; each must be in the mast file. None: the head alone, pointed by joint "
        "angles",
    )
    listen: Listen = Listen()
    pointing: PointingRecord = PointingRecord()
    record: RecordSettings = RecordSettings()
    simulation: Free = Field(default={}, description="the simulated rover behind driver: sim, below")
    tracking: TrackingSettings = TrackingSettings()
    state: StateRecord = Field(default=ABSENT)


def load_config(path: str | Path | None = None) -> Config:
    """Read a configuration; without a path the packaged one, which runs the simulated rover.

    Raises BadFile with the key, its value, and what is expected.
    """
    file = default_config() if path is None else Path(path)
    return parse_config(read_bytes(file, _MAX_BYTES), file)


def not_simulated(settings: HardwareSettings) -> tuple[str, str] | None:
    """Return the first device that is not simulated, and its driver; None if all are."""
    devices: dict[str, tuple[Kind, DeviceSettings]] = {PAN_TILT: ("head", settings.pan_tilt)}
    devices |= {name: ("camera", one) for name, one in settings.cameras.items()}
    real = {n: d.driver for n, (k, d) in devices.items() if not is_hardware("simulated", k, d.driver)}
    return next(iter(real.items()), None)


def load_head(path: str | Path) -> HardwareSettings:
    """Read the head of a configuration, whatever else that contains. Raises BadFile."""
    document = parse_mapping(read_bytes(Path(path), _MAX_BYTES), path)
    head = read_record(_HeadAlone, document, path).pan_tilt
    return HardwareSettings(DeviceSettings(head.driver, head.options), {}, folder=Path(path).resolve().parent)


def parse_config(data: bytes, path: str | Path) -> Config:
    """Read a configuration's bytes; relative paths in it start at the folder of ``path``. Raises BadFile."""
    record = parse_record(ConfigRecord, data, path, CONFIG_SCHEMA)
    head, cameras = record.pan_tilt, record.cameras.items()
    return Config(
        path=Path(path),
        mast_file=record.mast_file,
        listen=record.listen,
        hardware=HardwareSettings(
            pan_tilt=DeviceSettings(head.driver, head.options),
            cameras={name: DeviceSettings(one.driver, one.options, one.offset_s) for name, one in cameras},
            simulation=record.simulation,
            folder=Path(path).resolve().parent,
        ),
        limits=record.limits.limits,
        sun=record.limits.sun.direction if record.limits.sun else None,
        tracking=record.tracking,
        repeat_after_s=record.pointing.repeat_after_s,
        record=record.record,
        data=data,
        state_folder=record.state.folder if record.state else None,
    )


def check_cameras(config: Config, rig: Rig) -> None:
    """Pass a configuration whose cameras, and pairs to track with, the mast file knows.

    Raises BadFile with the camera or pair, and the nearest one that the mast file has.
    """
    for pair in config.tracking.handoff.pairs:
        if pair not in rig.stereo:
            reason = f"the mast file has no such pair; {_known(pair, tuple(rig.stereo))}"
            raise BadFile(config.path, f"tracking.handoff.pairs.{pair}", reason)
    known = tuple(rig.cameras)
    for name in config.hardware.cameras:
        if name not in known:
            reason = f"the mast file {config.mast_file} has no such camera; {_known(name, known)}"
            raise BadFile(config.path, f"cameras.{name}", reason)


def is_loopback(host: str) -> bool:
    """Return whether a host, as written, is this machine's own and only that."""
    if host == "localhost":
        return True
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False


def _known(name: str, known: tuple[str, ...]) -> str:
    """The nearest name in a mast file, or that it has none."""
    return nearest(name, known) if known else "it has none"


def parse_address(text: str) -> Listen:
    """Read ``HOST:PORT``, ``[HOST]:PORT`` or the path of a Unix socket, which has a slash in it.

    Raises ValueError.
    """
    if "/" in text:
        if len(os.fsencode(text)) > LONGEST_SOCKET_PATH:
            raise ValueError(f"'{text[:40]}...' is longer than {LONGEST_SOCKET_PATH} bytes, a socket's most")
        return Listen(socket=Path(text).absolute())
    try:
        parts = urlsplit(f"//{text}")
        host, port = parts.hostname, parts.port
    except ValueError:
        host = port = None
    if not host or port is None or set(text) & set("@?#") or not text.isprintable():
        raise ValueError(f"'{text[:80]}' where HOST:PORT (127.0.0.1:8420, [::1]:8420) or a path is expected")
    return Listen(host=host, port=port)
