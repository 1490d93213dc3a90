"""A unit halted by somebody who knows nothing about it but its line."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from drivers.flir_ptu.conversation import Conversation
from drivers.flir_ptu.options import DEVICE, options_from
from drivers.serial_line import SerialLine


def halt(options: Mapping[str, Any]) -> list[str]:
    """Halt both axes, and see that the unit took it; it holds where that ends. Sets nothing.

    Raises
    ------
    BadOptions
        For options that cannot be.
    LineLost, NoReply, BadReply, Refused
        If it was not confirmed; the command has been sent twice all the same, unless the line is lost.
    """
    read = options_from(options)
    talk = Conversation(SerialLine(read.port, read.baud, DEVICE), DEVICE, lambda axis: None)
    try:
        talk.shout("H")  # before any question
        talk.shout("H")
        talk.in_step()
        with talk.patient():
            talk.tell("H")
    finally:
        talk.close()
    return ["pan and tilt halted (H), confirmed"]
