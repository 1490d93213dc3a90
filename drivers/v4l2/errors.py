"""What can be wrong with a V4L2 camera, where a caller would act differently."""

from __future__ import annotations

from drivers.errors import BadOptions, DriverError


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


class NotACamera(BadOptions):
    """The path leads to something that gives no pictures."""

    code = "not_a_camera"


class UnsupportedFormat(BadOptions):
    """The camera does not offer the format, size or rate; the message says what it offers."""

    code = "unsupported_format"
