"""The configuration of one daemon (docs/reference/configuration.md), read strictly.

It is checked in two steps: what the file says by itself here, and what it says about the mast file when that
is read (`check_cameras`). Options of drivers are handed through as they stand; the drivers judge them.
"""

from __future__ import annotations

import ipaddress
import math
import os
import re
from dataclasses import dataclass, field
from pathlib import Path
from urllib.parse import quote

from calib.errors import BadFile
from calib.files import read_bytes
from calib.files.yaml_text import Section, nearest, parse_mapping
from calib.geometry.rig import Rig
from drivers.frame_times import MOST_OFFSET_S
from drivers.hardware import DeviceSettings, HardwareSettings
from mastctl.devices.keep_out import Box
from mastctl.devices.limits import (
    LEAST_CONE_RAD,
    SUN,
    WIDEST_CONE_RAD,
    Frame,
    Limits,
    SunDirection,
    direction_of,
)
from mastctl.motion.settings import HandoffRules, PairBounds, TrackingSettings
from mastctl.packaged import default_config
from mastctl.recorder.settings import RecordSettings

CONFIG_SCHEMA = "mastctl/config/1"
DEFAULT_HOST = "127.0.0.1"
DEFAULT_PORT = 8420

_MAX_BYTES = 1_000_000
_FULL_TURN_RAD = 6.2832
_FASTEST_RAD_PER_S = 100.0
_STEEPEST_RAD_PER_S2 = 1000.0
_WIDEST_MARGIN_RAD = 0.5
HOST_NAME = re.compile(r"[A-Za-z0-9]([A-Za-z0-9._-]{0,252})|[0-9A-Fa-f:]*:[0-9A-Fa-f:.]*")
_MOST_MB = 1e7
_LATEST_REPEAT_S = 60.0
LONGEST_SOCKET_PATH = 100  # bytes; the kernel's own bound is 108


@dataclass(frozen=True)
class Listen:
    """Where the daemon listens, and to which names it answers.

    Attributes
    ----------
    host, port
        An address of this machine; port 0 is any free one.
    socket
        A Unix socket instead, if not None.
    hosts
        Names that it answers to beside the loopback ones, in lower case.
    """

    host: str = DEFAULT_HOST
    port: int = DEFAULT_PORT
    socket: Path | None = None
    hosts: tuple[str, ...] = ()

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

    ``repeat_after_s``: as `mastctl.motion.settings.PointingSettings` has it, None for its default.
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


def load_config(path: str | Path | None = None) -> Config:
    """Read a configuration; without a path the packaged one, which runs the simulated rover.

    Raises
    ------
    BadFile
        If it cannot be read or used: which key, what it holds, and what is expected.
    """
    file = default_config() if path is None else Path(path)
    return parse_config(read_bytes(file, _MAX_BYTES), file)


def load_head(path: str | Path) -> HardwareSettings:
    """Read what a configuration says of its head and pass over whatever else it holds. Raises BadFile."""
    document = parse_mapping(read_bytes(Path(path), _MAX_BYTES), path)
    top = Section(path, "", document, ("pan_tilt",), tuple(map(str, document)))
    return HardwareSettings(pan_tilt=_head(top), cameras={}, folder=Path(path).resolve().parent)


def parse_config(data: bytes, path: str | Path) -> Config:
    """Read a configuration's bytes; relative paths in it start at the folder of ``path``. Raises BadFile."""
    document = parse_mapping(data, path)
    if document.get("schema") != CONFIG_SCHEMA:
        found = document.get("schema", "no such key")
        raise BadFile(path, "schema", f"'{str(found)[:60]}' where '{CONFIG_SCHEMA}' is expected")
    top = Section(
        path,
        "",
        document,
        ("schema", "mast_file", "pan_tilt", "limits"),
        ("cameras", "listen", "pointing", "record", "simulation", "tracking", "state"),
    )
    folder = Path(path).resolve().parent
    cameras = {name: _camera(top, name) for name in top.mapping("cameras")}
    return Config(
        path=Path(path),
        mast_file=folder / top.text("mast_file"),
        listen=_listen(top, folder),
        hardware=HardwareSettings(
            pan_tilt=_head(top),
            cameras=cameras,
            simulation=top.free("simulation"),
            folder=folder,
        ),
        limits=_limits(top),
        sun=_sun(top),
        tracking=_tracking(top, folder),
        repeat_after_s=_repeat_after_s(top),
        record=_record(top, folder),
        data=data,
        state_folder=_state_folder(top, folder),
    )


def check_cameras(config: Config, rig: Rig) -> None:
    """Pass a configuration whose cameras, and pairs to track with, the mast file knows.

    Raises
    ------
    BadFile
        Naming the camera or pair, and the nearest one that the mast file has.
    """
    for pair in config.tracking.named_pairs:
        if pair not in rig.stereo:
            words = f"the mast file has no such pair; {_known(pair, tuple(rig.stereo))}"
            raise BadFile(config.path, f"tracking.handoff.pairs.{pair}", words)
    known = tuple(rig.cameras)
    for name in config.hardware.cameras:
        if name not in known:
            words = f"the mast file {config.mast_file} has no such camera; {_known(name, known)}"
            raise BadFile(config.path, f"cameras.{name}", words)


def is_loopback(host: str) -> bool:
    """Return whether a host, as written, is this machine's own and only that."""
    if host == "localhost":
        return True
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False


def _known(word: str, known: tuple[str, ...]) -> str:
    """The nearest of what a mast file has, or that it has nothing of the kind."""
    return nearest(word, known) if known else "it has none"


def _head(top: Section) -> DeviceSettings:
    """Read ``{driver: NAME, options: {...}}``."""
    section = Section(top.path, "pan_tilt", top.values["pan_tilt"], ("driver",), ("options",))
    return DeviceSettings(section.text("driver"), section.free("options"))


def _camera(top: Section, name: str) -> DeviceSettings:
    """Read ``{driver: NAME, options: {...}, offset_s: SECONDS}``."""
    holder = top.mapping("cameras")[name]
    section = Section(top.path, f"cameras.{name}", holder, ("driver",), ("options", "offset_s"))
    offset_s = section.between("offset_s", -MOST_OFFSET_S, MOST_OFFSET_S, 0.0)
    return DeviceSettings(section.text("driver"), section.free("options"), offset_s)


def parse_address(text: str) -> Listen:
    """Read ``HOST:PORT``, ``[HOST]:PORT`` or the path of a Unix socket, which has a slash in it.

    Raises
    ------
    ValueError
        In words that say what is expected.
    """
    if "/" in text:
        if len(os.fsencode(text)) > LONGEST_SOCKET_PATH:
            raise ValueError(f"'{text[:40]}...' is longer than {LONGEST_SOCKET_PATH} bytes, a socket's most")
        return Listen(socket=Path(text).absolute())
    host, colon, port = text.rpartition(":")
    if host.startswith("[") and host.endswith("]"):
        host = host[1:-1]
    elif ":" in host:
        colon = ""
    if not (colon and host and port.isascii() and port.isdecimal() and int(port[:9]) <= 65535):
        raise ValueError(f"'{text[:80]}' where HOST:PORT (127.0.0.1:8420, [::1]:8420) or a path is expected")
    return Listen(host, int(port))


def _listen(top: Section, folder: Path) -> Listen:
    """Read ``{host, port}`` or ``{socket: PATH}``, with ``hosts``."""
    if "listen" not in top:
        return Listen()
    section = top.section("listen", (), ("host", "port", "socket", "hosts"))
    hosts = _hosts(section)
    if "socket" in section:
        for other in ("host", "port"):
            if other in section:
                raise section.bad(other, "stands beside 'socket'; one or the other is expected")
        socket = folder / section.text("socket")
        if len(os.fsencode(socket)) > LONGEST_SOCKET_PATH:
            raise section.bad("socket", f"{socket} is longer than {LONGEST_SOCKET_PATH} bytes")
        return Listen(socket=socket, hosts=hosts)
    host = section.text("host") if "host" in section else DEFAULT_HOST
    port = section.integer("port", 0, 65535) if "port" in section else DEFAULT_PORT
    return Listen(host, port, hosts=hosts)


def _hosts(section: Section) -> tuple[str, ...]:
    """Read the names to answer to."""
    named = section.values.get("hosts", [])
    if not isinstance(named, list) or not all(isinstance(one, str) for one in named):
        raise section.bad("hosts", "a list of names such as rover.local is expected")
    for name in named:
        if not HOST_NAME.fullmatch(name):
            raise section.bad("hosts", f"'{name[:60]}' where a name without scheme and port is expected")
    return tuple(name.lower() for name in named)


def _limits(top: Section) -> Limits:
    """Read the soft limits."""
    section = _limits_section(top)
    margin_rad = section.between("margin_rad", 0.0, _WIDEST_MARGIN_RAD, 0.0)
    pan_rad, tilt_rad = (_within(section, key, margin_rad) for key in ("pan_rad", "tilt_rad"))
    keep_out = tuple(_box(section, name) for name in section.mapping("keep_out"))
    if keep_out and margin_rad == 0.0:
        words = "is needed beside keep_out, above 0: what the head overshoots, rings and has as backlash"
        raise section.bad("margin_rad", words)
    return Limits(
        pan_rad,
        tilt_rad,
        section.positive("speed_rad_per_s", _FASTEST_RAD_PER_S),
        margin_rad,
        section.positive("acceleration_rad_per_s2", _STEEPEST_RAD_PER_S2)
        if "acceleration_rad_per_s2" in section
        else None,
        keep_out,
    )


def _limits_section(top: Section) -> Section:
    usual = ("margin_rad", "acceleration_rad_per_s2", "keep_out", "sun")
    return top.section("limits", ("pan_rad", "tilt_rad", "speed_rad_per_s"), usual)


def _within(section: Section, key: str, margin_rad: float) -> tuple[float, float]:
    """Read an axis's range and leave the margin at both ends."""
    low, high = section.ends(key, _FULL_TURN_RAD)
    if low + margin_rad >= high - margin_rad:
        words = f"[{low:g}, {high:g}] leaves nothing between margins of {margin_rad:g} rad"
        raise section.bad(key, words)
    return low + margin_rad, high - margin_rad


def _box(limits: Section, name: str) -> Box:
    """Read ``{pan_rad: [lowest, highest], tilt_rad: [lowest, highest]}`` of a keep-out."""
    place = limits.at(f"keep_out.{name}")
    if not isinstance(name, str) or not name.isidentifier() or name == SUN:
        raise limits.bad(f"keep_out.{name}", f"a name of letters, digits and _ is expected, not '{SUN}'")
    section = Section(limits.path, place, limits.mapping("keep_out")[name], ("pan_rad", "tilt_rad"))
    pan_rad, tilt_rad = section.ends("pan_rad", _FULL_TURN_RAD), section.ends("tilt_rad", _FULL_TURN_RAD)
    return Box(name, pan_rad, tilt_rad)


def _sun(top: Section) -> SunDirection | None:
    """Read the direction that no head camera looks into, in the rover or the site frame."""
    limits = _limits_section(top)
    if "sun" not in limits:
        return None
    section = limits.section("sun", ("azimuth_rad", "elevation_rad", "half_angle_rad"), ("frame",))
    azimuth_rad = section.number("azimuth_rad", _FULL_TURN_RAD)
    elevation_rad = section.number("elevation_rad", math.pi / 2)
    half_angle_rad = section.between("half_angle_rad", LEAST_CONE_RAD, WIDEST_CONE_RAD)
    frame: Frame = "site"
    if "frame" in section and section.choice("frame", ("site", "rover")) == "rover":
        frame = "rover"
    return SunDirection(direction_of(azimuth_rad, elevation_rad), frame, half_angle_rad)


def _tracking(top: Section, folder: Path) -> TrackingSettings:
    """Read how targets are followed; what is left out stays as it is."""
    usual = TrackingSettings()
    if "tracking" not in top:
        return usual
    section = top.section("tracking", (), ("handoff", "most_step", "start_error", "handoff_log"))
    rules, named = usual.handoff, tuple[str, ...]()
    if "handoff" in section:
        keys = ("pairs", "margin_px", "disparity_error_px", "range_error")
        handoff = section.section("handoff", (), keys)
        named = tuple(handoff.mapping("pairs"))
        pairs = {name: _pair_bounds(handoff, name) for name in named}
        rules = HandoffRules(
            pairs={**rules.pairs, **pairs},
            margin_px=handoff.between("margin_px", 0.0, 1000.0, rules.margin_px),
            disparity_error_px=handoff.between("disparity_error_px", 0.001, 100.0, rules.disparity_error_px),
            range_error=handoff.between("range_error", 0.001, 10.0, rules.range_error),
        )
    return TrackingSettings(
        handoff=rules,
        most_step=section.between("most_step", 0.01, 1.0, usual.most_step),
        start_error=section.between("start_error", 0.001, 1.0, usual.start_error),
        named_pairs=named,
        handoff_log=folder / section.text("handoff_log") if "handoff_log" in section else None,
    )


def _repeat_after_s(top: Section) -> float | None:
    """Read ``{repeat_after_s: SECONDS}`` of the key ``pointing``; None where it does not say."""
    if "pointing" not in top:
        return None
    section = top.section("pointing", (), ("repeat_after_s",))
    if "repeat_after_s" not in section:
        return None
    return section.between("repeat_after_s", 0.0, _LATEST_REPEAT_S)


def _state_folder(top: Section, folder: Path) -> Path | None:
    """Read ``{folder: PATH}``; None where the usual place is to be used."""
    if "state" not in top:
        return None
    return folder / top.section("state", ("folder",), ()).text("folder")


def _record(top: Section, folder: Path) -> RecordSettings:
    """Read how much is recorded, and where; what is left out stays as it is."""
    usual = RecordSettings()
    if "record" not in top:
        return usual
    section = top.section("record", (), ("ring_s", "ring_mb", "kept_mb", "run_mb", "free_mb", "folder"))
    return RecordSettings(
        ring_s=section.between("ring_s", 0.0, 86400.0) if "ring_s" in section else None,
        ring_mb=section.between("ring_mb", 10.0, _MOST_MB, usual.ring_mb),
        kept_mb=section.between("kept_mb", 10.0, _MOST_MB, usual.kept_mb),
        run_mb=section.between("run_mb", 10.0, _MOST_MB, usual.run_mb),
        free_mb=section.between("free_mb", 10.0, _MOST_MB, usual.free_mb),
        folder=folder / section.text("folder") if "folder" in section else None,
    )


def _pair_bounds(handoff: Section, name: str) -> PairBounds:
    """Read ``{nearest_m, steepest_rad}`` of a pair."""
    usual = PairBounds()
    place = handoff.at(f"pairs.{name}")
    value = handoff.mapping("pairs")[name]
    section = Section(handoff.path, place, value, (), ("nearest_m", "steepest_rad"))
    return PairBounds(
        nearest_m=section.between("nearest_m", 0.0, 1000.0, usual.nearest_m),
        steepest_rad=section.between("steepest_rad", 0.0, usual.steepest_rad, usual.steepest_rad),
    )
