"""Errors of the drivers floor: one base, a subclass where a caller would act differently.

``code`` is the name that programs read (in the API's error objects); the message is for people and says
device, what happened, value and bound.
"""

from __future__ import annotations


class DriverError(Exception):
    """Base of every fault that a device or its stand-in reports."""

    code = "driver_error"

    def __init__(self, message: str, *, device: str = "") -> None:
        self.device = device
        super().__init__(f"{device}: {message}" if device else message)


class BadOptions(DriverError):
    """The configuration asks a driver for something that it does not have."""

    code = "bad_options"


class NoReply(DriverError):
    """The device did not answer within its deadline."""

    code = "no_reply"


class BadReply(DriverError):
    """The device answered, but the answer cannot be true (not finite, out of range, wrong size)."""

    code = "bad_reply"


class NoFreshFrame(DriverError):
    """No frame exposed after the asked moment came in time; the message says what came instead."""

    code = "no_fresh_frame"


class BadFrame(DriverError):
    """A frame came but cannot be used: dark, frozen, damaged, of another size."""

    code = "bad_frame"
