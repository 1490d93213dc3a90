"""The C library Aravis by ctypes: only what this driver calls, and its errors as Python's.

It is bound and not imported by GObject introspection, which would need the system's own Python
(docs/decisions/design.md). A call lets go of Python's lock while it lasts.
"""

from __future__ import annotations

import ctypes
import resource
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

from drivers.errors import BadOptions, StreamFailed

SONAME = "libaravis-0.8.so.0"
INSTALL = "sudo apt-get install aravis-tools-cli"

CONTROL_LOST = ctypes.CFUNCTYPE(None, ctypes.c_void_p, ctypes.c_void_p)

_TYPES: dict[str, Any] = {
    "v": None, "p": ctypes.c_void_p, "s": ctypes.c_char_p, "i": ctypes.c_int, "u": ctypes.c_uint,
    "q": ctypes.c_int64, "Q": ctypes.c_uint64, "d": ctypes.c_double, "z": ctypes.c_size_t,
}  # fmt: skip

_FUNCTIONS = {
    "arv_update_device_list": ">v",
    "arv_get_n_devices": ">u",
    "arv_get_device_id": "u>s",
    "arv_get_device_address": "u>s",
    "arv_get_device_serial_nbr": "u>s",
    "arv_get_device_vendor": "u>s",
    "arv_get_device_model": "u>s",
    "arv_get_device_protocol": "u>s",
    "arv_camera_new": "s>p!",
    "arv_camera_get_device": "p>p",
    "arv_camera_is_gv_device": "p>i",
    "arv_camera_get_vendor_name": "p>s!",
    "arv_camera_get_model_name": "p>s!",
    "arv_camera_get_device_serial_number": "p>s!",
    "arv_camera_set_region": "piiii>v!",
    "arv_camera_get_region": "ppppp>v!",
    "arv_camera_get_width_bounds": "ppp>v!",
    "arv_camera_get_height_bounds": "ppp>v!",
    "arv_camera_set_pixel_format_from_string": "ps>v!",
    "arv_camera_get_pixel_format_as_string": "p>s!",
    "arv_camera_dup_available_pixel_formats_as_strings": "pp>p!",
    "arv_camera_dup_available_trigger_sources": "pp>p!",
    "arv_camera_is_frame_rate_available": "p>i!",
    "arv_camera_set_frame_rate": "pd>v!",
    "arv_camera_get_frame_rate": "p>d!",
    "arv_camera_is_exposure_time_available": "p>i!",
    "arv_camera_set_exposure_time": "pd>v!",
    "arv_camera_get_exposure_time": "p>d!",
    "arv_camera_get_exposure_time_bounds": "ppp>v!",
    "arv_camera_is_gain_available": "p>i!",
    "arv_camera_set_gain": "pd>v!",
    "arv_camera_get_gain": "p>d!",
    "arv_camera_get_gain_bounds": "ppp>v!",
    "arv_camera_set_trigger": "ps>v!",
    "arv_camera_clear_triggers": "p>v!",
    "arv_camera_set_acquisition_mode": "pi>v!",
    "arv_camera_gv_set_stream_options": "pi>v",
    "arv_camera_are_chunks_available": "p>i!",
    "arv_camera_set_chunk_mode": "pi>v!",
    "arv_camera_set_chunk_state": "psi>v!",
    "arv_camera_create_chunk_parser": "p>p",
    "arv_chunk_parser_get_float_value": "pps>d!",
    "arv_camera_is_feature_available": "ps>i!",
    "arv_camera_execute_command": "ps>v!",
    "arv_camera_get_boolean": "ps>i!",
    "arv_camera_get_string": "ps>s!",
    "arv_camera_set_string": "pss>v!",
    "arv_camera_get_integer": "ps>q!",
    "arv_device_set_features_from_string": "ps>i!",
    "arv_camera_get_payload": "p>u!",
    "arv_camera_create_stream": "pppp>p!",
    "arv_camera_start_acquisition": "p>v!",
    "arv_camera_stop_acquisition": "p>v!",
    "arv_stream_push_buffer": "pp>v",
    "arv_stream_timeout_pop_buffer": "pQ>p",
    "arv_buffer_new_allocate": "z>p",
    "arv_buffer_get_status": "p>i",
    "arv_buffer_get_timestamp": "p>Q",
    "arv_buffer_get_system_timestamp": "p>Q",
    "arv_buffer_get_frame_id": "p>Q",
    "arv_buffer_get_n_parts": "p>u",
    "arv_buffer_get_image_data": "pp>p",
    "arv_buffer_get_image_width": "p>i",
    "arv_buffer_get_image_height": "p>i",
}
"""Arguments and result by `_TYPES`; ``!``: a GError is the last argument."""


_OPENING = frozenset({"arv_update_device_list", "arv_camera_new", "arv_camera_create_stream"})
FREE_DESCRIPTORS = 16
"""What must be free before a call that opens some. GLib ends the whole process where it gets none."""


class GenicamError(Exception):
    """Aravis refused a call: because of the camera's features, or of the line to it."""


class _GError(ctypes.Structure):
    _fields_ = (("domain", ctypes.c_uint32), ("code", ctypes.c_int), ("message", ctypes.c_char_p))


class Library:
    """The loaded library. Raises OSError if it is not installed."""

    def __init__(self) -> None:
        arv = ctypes.CDLL(SONAME)
        glib, gobject = ctypes.CDLL("libglib-2.0.so.0"), ctypes.CDLL("libgobject-2.0.so.0")
        self._free_error = _declared(glib, "g_error_free", "p>v")
        self._free = _declared(glib, "g_free", "p>v")
        self._connect = _declared(gobject, "g_signal_connect_data", "pspppi>Q")
        self.unref = _declared(gobject, "g_object_unref", "p>v")
        self._functions = {name: _declared(arv, name, types) for name, types in _FUNCTIONS.items()}

    def __call__(self, name: str, *arguments: Any) -> Any:
        """Call ``arv_NAME``; texts are str on both sides.

        Raises GenicamError if Aravis refuses it; StreamFailed if the process may hardly open another file,
        for a call that would.
        """
        name = f"arv_{name}"
        if name in _OPENING:
            _check_descriptors()
        given = [one.encode() if isinstance(one, str) else one for one in arguments]
        if not _FUNCTIONS[name].endswith("!"):
            result = self._functions[name](*given)
        else:
            error = ctypes.POINTER(_GError)()
            result = self._functions[name](*given, ctypes.byref(error))
            if error:
                message = (error.contents.message or b"no reason given").decode(errors="replace")
                self._free_error(error)
                raise GenicamError(message)
        return result.decode(errors="replace") if isinstance(result, bytes) else result

    def texts(self, name: str, handle: int) -> list[str]:
        """Call a function that returns a list of texts. Raises GenicamError."""
        count = ctypes.c_uint()
        found = self(name, handle, ctypes.byref(count))
        if not found:
            return []
        entries = ctypes.cast(found, ctypes.POINTER(ctypes.c_char_p))[: count.value]
        self._free(found)
        return [entry.decode(errors="replace") for entry in entries if entry]

    def on_control_lost(self, device: int, function: Any) -> None:
        """Have a `CONTROL_LOST` called, in a thread of Aravis, when the camera no longer obeys."""
        self._connect(device, b"control-lost", function, None, None, 0)


def _declared(library: ctypes.CDLL, name: str, types: str) -> Callable[..., Any]:
    """A function with its types."""
    given, _, result = types.rstrip("!").partition(">")
    function = getattr(library, name)
    function.argtypes = [_TYPES[letter] for letter in given] + [ctypes.c_void_p] * types.endswith("!")
    function.restype = _TYPES[result]
    return function  # type: ignore[no-any-return]


def _check_descriptors() -> None:
    most, _ = resource.getrlimit(resource.RLIMIT_NOFILE)
    try:
        in_use = sum(1 for _ in Path("/proc/self/fd").iterdir())
    except OSError:  # there is not one left for the folder itself
        in_use = most
    if in_use + FREE_DESCRIPTORS > most:
        raise StreamFailed(
            f"{in_use} of at most {most} files and connections are open in this process, and a GenICam "
            f"camera needs {FREE_DESCRIPTORS} free ones; close some, or raise LimitNOFILE= (ulimit -n)"
        )


@cache
def _loaded() -> Library:
    return Library()


def library(name: str = "") -> Library:
    """Return Aravis, loaded once.

    Raises BadOptions if it is not installed; the message says how to install it. ``name`` is the camera's.
    """
    try:
        return _loaded()
    except (OSError, AttributeError) as error:
        raise BadOptions(
            f"driver 'aravis' needs the library Aravis, version 0.8 ({error}); {INSTALL}", device=name
        ) from None


def installed() -> bool:
    """Return whether the library is there."""
    try:
        return bool(_loaded())
    except (OSError, AttributeError):
        return False
