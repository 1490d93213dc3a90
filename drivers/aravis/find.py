"""Which camera is which: by serial number, IP address, or the name that Aravis gives it."""

from __future__ import annotations

import ctypes
import threading
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from drivers.aravis.library import INSTALL, GenicamError, Library, installed, library
from drivers.aravis.settings import AravisOptions, parse_options
from drivers.errors import BadOptions, CameraBusy, DriverError, NoCamera, StreamFailed, UnsupportedFormat
from drivers.pixels import GENICAM
from drivers.registry import ProbedCamera

_LISTING = threading.Lock()
"""Aravis has one list of devices, which each search makes anew."""


@dataclass(frozen=True)
class FoundGenicam:
    """One camera that answered: its names, where it is, and by which protocol."""

    id: str
    vendor: str
    model: str
    serial: str
    address: str
    protocol: str

    @property
    def name(self) -> str:
        """Maker, model, serial number and place, in one sentence."""
        return f"{self.vendor} {self.model}, serial number {self.serial}, at {self.address} ({self.protocol})"


def list_cameras() -> list[FoundGenicam]:
    """Return the cameras on network and USB, which takes a second; none if Aravis is not installed."""
    return _listed(library()) if installed() else []


def options_for(camera: FoundGenicam, by_serial: bool, fastest_hz: float) -> dict[str, Any]:
    """Return options that open a camera as it is now: its format (else the first that is read), region, rate.

    Raises DriverError if another program has it, it does not answer, or it has no format that is read.
    """
    name = camera.name
    arv, handle = library(name), open_camera(AravisOptions(id=camera.id), name)
    try:
        offered = arv.texts("camera_dup_available_pixel_formats_as_strings", handle)
        now = arv("camera_get_pixel_format_as_string", handle)
        read = [one for one in (now, *offered) if one in GENICAM]
        if not read:
            raise UnsupportedFormat(
                f"this driver reads none of its formats {', '.join(offered)}", device=name
            )
        region = [ctypes.c_int() for _ in range(4)]
        arv("camera_get_region", handle, *(ctypes.byref(one) for one in region))
        x, y, width, height = (one.value for one in region)
        has_rate = arv("camera_is_frame_rate_available", handle)
        rate_hz = arv("camera_get_frame_rate", handle) if has_rate else 0.0
    except GenicamError as error:
        raise StreamFailed(f"it cannot be queried: {error}", device=name) from None
    finally:
        arv.unref(handle)
    return {
        **({"serial": camera.serial} if by_serial else {"id": camera.id}),
        "format": read[0],
        "size_px": [width, height],
        **({"offset_px": [x, y]} if (x, y) != (0, 0) else {}),
        "rate_hz": round(min(rate_hz, fastest_hz), 3) if rate_hz > 0 else None,
    }


def is_meant(options: AravisOptions, found: FoundGenicam) -> bool:
    """Return whether the options name a camera that was found."""
    pairs = ((options.serial, found.serial), (options.address, found.address), (options.id, found.id))
    return all(wanted in ("", got) for wanted, got in pairs)


def _listed(arv: Library) -> list[FoundGenicam]:
    names = ("id", "vendor", "model", "serial_nbr", "address", "protocol")
    with _LISTING:
        arv("update_device_list")
        count = arv("get_n_devices")
        return [FoundGenicam(*(arv(f"get_device_{one}", i) or "" for one in names)) for i in range(count)]


def open_camera(options: AravisOptions, name: str) -> int:
    """Open the camera that the options name and return Aravis's handle.

    Raises CameraBusy if another program controls it; BadOptions if several cameras bear the serial number;
    NoCamera.
    """
    arv = library(name)
    key = options.address or options.id
    if options.serial:
        found = _listed(arv)
        named = [one for one in found if is_meant(options, one)]
        if len(named) > 1:
            raise BadOptions(_several(options, named), device=name)
        if not named:
            raise _absent(options, name, found)
        key = named[0].id
    try:
        handle: Any = arv("camera_new", key)
    except GenicamError as error:
        message = str(error)
        if "control" in message.lower() or "access" in message.lower():
            raise CameraBusy(f"another program has it ({message})", device=name) from None
        raise _absent(options, name, _listed(arv), message) from None
    if not handle:
        raise _absent(options, name, _listed(arv))
    return int(handle)


def _absent(options: AravisOptions, name: str, found: list[FoundGenicam], why: str = "") -> NoCamera:
    connected = "; ".join(one.name for one in found) or "none"
    said = f" ({why})" if why else ""
    return NoCamera(f"no camera with {options.camera} answers{said}; there are: {connected}", device=name)


USUAL_HZ = 30.0
NOT_INSTALLED = f"GigE Vision and USB3 Vision cameras are found only with the library Aravis: {INSTALL}"


def probe() -> tuple[list[ProbedCamera], list[str], str]:
    """Return cameras as `drivers.registry.Driver.probe`."""
    cameras: list[ProbedCamera] = []
    others: list[str] = []
    found = sorted(list_cameras(), key=lambda one: (one.serial, one.id))
    serials = [one.serial for one in found]
    for one in found:
        try:
            options = options_for(one, bool(one.serial) and serials.count(one.serial) == 1, USUAL_HZ)
        except DriverError as error:
            others.append(str(error))
            continue
        name = f"{one.vendor} {one.model} {one.serial}"
        cameras.append(ProbedCamera(name, one.address or one.protocol, None, options, "aravis"))
    return cameras, others, "" if installed() else NOT_INSTALLED


def present(options: Mapping[str, Any], name: str) -> str:
    """Return which camera a configuration names, as `drivers.registry.CameraBench`; it is not opened.

    Raises BadOptions, NoCamera.
    """
    wanted = parse_options(options, name)
    library(name)
    connected = list_cameras()
    found = [one for one in connected if is_meant(wanted, one)]
    if not found and wanted.address:
        return f"no camera with {wanted.camera} answers to a search; mastctl camera check says more"
    if not found:
        raise _absent(wanted, name, connected)
    if len(found) > 1:
        raise BadOptions(_several(wanted, found), device=name)
    return found[0].name


def _several(options: AravisOptions, found: list[FoundGenicam]) -> str:
    return f"several cameras have {options.camera}: {', '.join(one.id for one in found)}; give 'id'"
