"""A unit made ready: halted, compared with the options, limits and speeds set, and seen. Moves nothing."""

from __future__ import annotations

import logging
from collections.abc import Mapping

from drivers.clock import Clock
from drivers.errors import Refused, WrongDevice
from drivers.flir_ptu import conversation as ask
from drivers.flir_ptu.axis import StepAxis
from drivers.flir_ptu.conversation import Conversation
from drivers.flir_ptu.options import DEVICE, Options
from drivers.flir_ptu.position import measure

log = logging.getLogger(__name__)

RECOMPUTE_S = 10.0  # PA and TA take seconds, the manual says


def checked_version(talk: Conversation, options: Options, known: str) -> str:
    """Return what the unit says about itself.

    Parameters
    ----------
    known
        What it said before; empty if it was not asked yet.

    Raises
    ------
    WrongDevice
        If it is another unit, or an E46 and the options do not say its resolutions.
    NoReply, BadReply, Refused, LineLost
        As `Conversation.tell`.
    """
    version = talk.sure_text("V")
    if known and version != known:
        words = f"another unit answers: '{version[:80]}' where '{known[:80]}' was"
        raise WrongDevice(words, device=DEVICE)
    if "E46" in version and None in (options.pan.resolution_arcsec, options.tilt.resolution_arcsec):
        raise WrongDevice(
            "is an E46, which does not know its gears before it was homed: "
            "options.pan.resolution_arcsec and options.tilt.resolution_arcsec have to say what is right",
            device=DEVICE,
        )
    return version


def ready_axes(
    talk: Conversation,
    options: Options,
    resolutions: Mapping[str, float],
    known: Mapping[str, StepAxis],
    clock: Clock,
) -> dict[str, StepAxis]:
    """Halt the unit, set its limits and speeds, and return its axes, by name, as they are seen now.

    Parameters
    ----------
    resolutions
        What it says that a position is, seconds of arc.
    known
        The axes before the unit or its line was away, whose usual speeds are kept; empty the first time.

    Raises
    ------
    WrongDevice
        If it does not fit the options.
    NoReply, BadReply, Refused, LineLost
        As `Conversation.ask` and `Conversation.tell`.
    """
    talk.tell("H")
    _try(talk, "CI")  # goals are positions, not speeds
    for command in ("PO0", "TO0", "I"):  # whatever was given in slaved mode and never started is void
        talk.tell(command)
    settings = {"pan": options.pan, "tilt": options.tilt}
    axes = {
        name: StepAxis(name, settings[name], talk.sure(ask.RESOLUTION[name], resolutions[name]))
        for name in settings
    }
    _try(talk, "LE")
    for axis in axes.values():
        axis.lowest, axis.highest = (int(talk.sure(q[axis.name])) for q in (ask.LOWEST, ask.HIGHEST))
        axis.check_limits()
    _limit(talk, axes)
    for name, axis in axes.items():
        axis.fastest, axis.slowest = talk.sure(ask.FASTEST[name]), talk.sure(ask.SLOWEST[name])
        if options.speed_rad_per_s is not None:
            axis.usual_speed = axis.speed_from_rad(options.speed_rad_per_s)
        elif name in known:
            axis.usual_speed = known[name].usual_speed
        else:
            axis.usual_speed = int(talk.sure(ask.SPEED[name]))
        axis.acceleration = int(talk.sure(ask.ACCELERATION[name]))
        if options.acceleration_rad_per_s2 is not None:
            _accelerate(talk, axis, options.acceleration_rad_per_s2)
    measure(talk, axes["pan"], axes["tilt"], clock)
    return axes


def _limit(talk: Conversation, axes: Mapping[str, StepAxis]) -> None:
    """Put the configuration's limits into the unit, if it has user limits."""
    try:
        for name, axis in axes.items():
            for letter, end in zip("NX", axis.soft_limits(), strict=True):
                talk.tell(f"{name[0].upper()}{letter}U{end}")
        talk.tell("LU")
    except Refused as error:
        log.info("%s: only its factory limits hold inside the unit (%s)", DEVICE, error)
        _try(talk, "LE")


def _accelerate(talk: Conversation, axis: StepAxis, acceleration_rad_per_s2: float) -> None:
    """Set the acceleration, if the unit has another."""
    positions = max(1, round(acceleration_rad_per_s2 / axis.position_rad))
    if axis.acceleration != positions:
        talk.tell(f"{axis.name[0].upper()}A{positions}", RECOMPUTE_S)
        axis.acceleration = positions


def _try(talk: Conversation, command: str) -> None:
    """Send a command that not every firmware has."""
    try:
        talk.tell(command)
    except Refused as error:
        log.info("%s", error)
