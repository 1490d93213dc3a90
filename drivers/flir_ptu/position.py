"""Asking a unit where both axes are at one moment, though its protocol cannot detect a damaged digit.

An answer is taken at once only where the axis rests by all that is known. Otherwise the unit is asked again,
and a middle answer is taken if it lies between its neighbours, and these no further apart than the axis can
go meanwhile: with one of them damaged, what is taken still is where the axis was during the call.

A unit tells one axis at a time. Where both move they are asked by turns, and what is taken is a middle answer
of pan, and for its moment tilt on the straight line between the two middle answers around it, if tilt turns
evenly there.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

from drivers.clock import Clock
from drivers.errors import BadReply
from drivers.flir_ptu.axis import Seen, StepAxis
from drivers.flir_ptu.conversation import POSITION, Conversation
from drivers.flir_ptu.options import DEVICE

ASKED_AT_MOST = 12  # questions for one axis; three or four do on a good line
MOST_BEND_RAD = 0.01
"""How far tilt may be from the straight line, by what its speed changes there."""


def measure(talk: Conversation, pan: StepAxis, tilt: StepAxis, clock: Clock) -> float:
    """Ask for both positions until they can be taken, have the axes take them, and return their moment.

    Raises
    ------
    BadReply
        If the positions contradict each other, or as `Conversation.ask`.
    NoReply, Refused, LineLost
        As `Conversation.ask`.
    """
    asked: dict[StepAxis, list[Seen]] = {tilt: [], pan: []}
    at_rest: dict[StepAxis, Seen] = {}
    found: tuple[Seen, Seen] | None = None
    while found is None:
        for axis, answers in asked.items():
            if axis not in at_rest and found is None:
                if len(answers) == ASKED_AT_MOST:
                    words = ", ".join(str(seen.position) for seen in answers)
                    raise BadReply(
                        f"gives {axis.name} positions that contradict each other: {words}", device=DEVICE
                    )
                answers.append(_ask(talk, axis, clock))
                if axis.rests_at(answers[-1]):
                    at_rest[axis] = answers[-1]
                if len(asked[pan]) and len(asked[tilt]):
                    found = _found(pan, tilt, asked[pan], asked[tilt], at_rest)
    for axis, seen in zip((pan, tilt), found, strict=True):
        axis.take(seen)
    return found[0].time_s


def _ask(talk: Conversation, axis: StepAxis, clock: Clock) -> Seen:
    """One answer, and when it was measured."""
    before_s = clock.now_s()
    number = talk.ask(POSITION[axis.name])
    # The unit looks when the question is there; its answer takes ten times as long on the wire.
    took_s = min((clock.now_s() - before_s) / 2, 4 * talk.byte_s)
    return Seen(round(number), before_s + took_s)


def _found(
    pan: StepAxis, tilt: StepAxis, pans: Sequence[Seen], tilts: Sequence[Seen], at_rest: dict[StepAxis, Seen]
) -> tuple[Seen, Seen] | None:
    """Pan and tilt at one moment, as far as the answers tell; None if they do not yet."""
    if pan in at_rest and tilt in at_rest:
        time_s = (at_rest[pan].time_s + at_rest[tilt].time_s) / 2
        return Seen(at_rest[pan].position, time_s), Seen(at_rest[tilt].position, time_s)
    if tilt in at_rest:
        seen = _middle(pan, pans)
        return None if seen is None else (seen, Seen(at_rest[tilt].position, seen.time_s))
    if pan in at_rest:
        seen = _middle(tilt, tilts)
        return None if seen is None else (Seen(at_rest[pan].position, seen.time_s), seen)
    if len(tilts) < 4 or len(tilts) == len(pans) or _middle(tilt, tilts[:-1]) is None:
        return None
    seen, other = _middle(pan, pans), _middle(tilt, tilts)
    if seen is None or other is None or _bend_rad(tilt, tilts[-4:]) > MOST_BEND_RAD:
        return None
    before = tilts[-3]
    part = (seen.time_s - before.time_s) / max(other.time_s - before.time_s, 1e-6)
    return seen, Seen(round(before.position + part * (other.position - before.position)), seen.time_s)


def _middle(axis: StepAxis, answers: Sequence[Seen]) -> Seen | None:
    """The last answer but one, if those around it confirm it."""
    if len(answers) < 3 or not axis.confirms(*answers[-3:]):
        return None
    return answers[-2]


def _bend_rad(axis: StepAxis, four: Sequence[Seen]) -> float:
    """How far from the straight line between the middle two of four answers the axis may have been.

    No further than these two are apart, and than its change of speed around them carries it.
    """
    speeds = [
        (then.position - now.position) / max(then.time_s - now.time_s, 1e-6) for now, then in pairwise(four)
    ]
    change = max(abs(speeds[1] - speeds[0]), abs(speeds[2] - speeds[1]))
    bend = change * (four[2].time_s - four[1].time_s) / 2
    return min(bend, abs(four[2].position - four[1].position)) * axis.position_rad
