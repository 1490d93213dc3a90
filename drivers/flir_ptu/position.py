"""Asking a unit for a position that can be taken for true, though its protocol cannot detect a damaged digit.

A position is taken at once only where the axis rests by all that is known. Otherwise the unit is asked three
times, and the middle answer is taken if it lies between the other two, and these no further apart than the
axis can go meanwhile: with one of them damaged, what is taken still is where the axis was during the call.
"""

from __future__ import annotations

from drivers.clock import Clock
from drivers.errors import BadReply
from drivers.flir_ptu.axis import Axis, Seen
from drivers.flir_ptu.conversation import POSITION, Conversation
from drivers.flir_ptu.options import DEVICE

ASKED_AT_MOST = 7  # questions for one position


def measure(talk: Conversation, axis: Axis, clock: Clock) -> Seen:
    """Ask for a position until it can be taken, and have the axis take it.

    Raises
    ------
    BadReply
        If the positions contradict each other, or as `Conversation.ask`.
    NoReply, Refused, LineLost
        As `Conversation.ask`.
    """
    asked: list[Seen] = []
    while len(asked) < ASKED_AT_MOST:
        before_s = clock.now_s()
        number = talk.ask(POSITION[axis.name])
        # The unit looks when the question is there; its answer takes ten times as long on the wire.
        took_s = min((clock.now_s() - before_s) / 2, 4 * talk.byte_s)
        asked.append(Seen(round(number), before_s + took_s))
        if axis.rests_at(asked[-1]) or (len(asked) >= 3 and axis.confirms(*asked[-3:])):
            seen = asked[-1] if axis.rests_at(asked[-1]) else asked[-2]
            axis.take(seen)
            return seen
    words = ", ".join(str(seen.position) for seen in asked)
    raise BadReply(f"gives {axis.name} positions that contradict each other: {words}", device=DEVICE)
