"""Errors of the drivers floor: one base, a subclass where a caller would act differently.

``code`` is the name that programs read (in the API's error objects); the message is for people and says
device, what happened, value and bound.
"""

from __future__ import annotations

from collections.abc import Mapping


class DriverError(Exception):
    """Base of every fault that a device or its stand-in reports.

    The device's name is put before the message. ``detail`` are facts for programs (port, servo id, register,
    instruction); must be JSON.
    """

    code = "driver_error"

    def __init__(self, message: str, *, device: str = "", detail: Mapping[str, object] | None = None) -> None:
        self.device = device
        self.detail = dict(detail or {})
        super().__init__(f"{device}: {message}" if device else message)


class BadOptions(DriverError):
    """The configuration names something that a driver does not have."""

    code = "bad_options"


class BadSetting(BadOptions):
    """A setting of a camera that it does not have, cannot change now, or that is out of its bounds."""

    code = "bad_setting"


class NoReply(DriverError):
    """The device did not answer within its deadline."""

    code = "no_reply"


class BadReply(DriverError):
    """The device answered, but the answer cannot be true (not finite, out of range, wrong size)."""

    code = "bad_reply"


class LineLost(DriverError):
    """The line to the device is gone or cannot be opened (unplugged, no permission, held by another)."""

    code = "line_lost"


class WrongDevice(DriverError):
    """The device that answers does not fit the configuration: another model, firmware, mode or place."""

    code = "wrong_device"


class Refused(DriverError):
    """The device understood the instruction and refused it; the message says why it says so."""

    code = "refused_by_device"


class OutOfRange(DriverError):
    """A goal or speed that the device's own limits do not allow; nothing moves."""

    code = "out_of_range"


class HardwareFault(DriverError):
    """The device reports damage or danger to itself: overload, overheating, voltage, encoder, shock."""

    code = "hardware_fault"


class WatchdogTripped(DriverError):
    """The device stopped by itself since its host was silent; moving again must be requested anew."""

    code = "watchdog_tripped"


class NoFreshFrame(DriverError):
    """No frame exposed after the requested moment came in time; the message says what came instead."""

    code = "no_fresh_frame"


class BadFrame(DriverError):
    """A frame came but cannot be used: dark, frozen, damaged, of another size."""

    code = "bad_frame"


class NoCamera(DriverError):
    """The camera is not connected, or went away while it was in use."""

    code = "no_camera"


class CameraBusy(DriverError):
    """Another program has the camera."""

    code = "camera_busy"


class NoPermission(DriverError):
    """This user may not open the device; the message says which group may."""

    code = "no_permission"


class StreamFailed(DriverError):
    """The camera is there but its driver cannot deliver frames."""

    code = "stream_failed"


class UnsupportedFormat(BadOptions):
    """The camera does not offer the format, size or rate; the message says what it offers."""

    code = "unsupported_format"
