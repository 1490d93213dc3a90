"""A unit halted by somebody who knows nothing about it but its line."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from drivers.clock import Clock, SystemClock
from drivers.flir_ptu.conversation import Conversation
from drivers.flir_ptu.options import DEVICE, options_from
from drivers.serial_line import OpenLine, SerialLine


def halt(
    options: Mapping[str, Any], clock: Clock | None = None, open_line: OpenLine = SerialLine
) -> list[str]:
    """Halt both axes, and see that the unit took it; it holds where that ends. Sets nothing.

    ``clock`` and ``open_line`` are as of `drivers.flir_ptu.head.open_head`.

    Raises
    ------
    BadOptions
        For options that cannot be.
    LineLost, NoReply, BadReply, Refused
        If it was not confirmed; the command has been sent twice all the same, unless the line is lost.
    """
    read = options_from(options)
    line = open_line(read.port, read.baud, DEVICE)
    talk = Conversation(line, DEVICE, lambda axis: None, clock or SystemClock())
    try:
        talk.shout("H")  # before any question
        talk.shout("H")
        talk.in_step()
        with talk.patient():
            talk.tell("H")
    finally:
        talk.close()
    return ["pan and tilt halted (H), confirmed"]
