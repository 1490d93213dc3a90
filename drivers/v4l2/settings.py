"""The settings that go by meaning: exposure, gain, white balance and focus, at the opening and at run time.

Each is a control in the device's own units with an automatic beside it that has to be off. At run time they
are changed through a second opening of the node, so the thread that takes the frames is not in the way.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from drivers.clock import Clock
from drivers.errors import DriverError
from drivers.interfaces import CameraSetting
from drivers.v4l2 import abi
from drivers.v4l2.controls import CameraControl, first_of, get_value, list_controls, set_value
from drivers.v4l2.node import Node
from drivers.v4l2.options import CameraOptions
from drivers.values_set import ValuesSet, change_each

EXPOSURE_UNIT_S = 1e-4  # of V4L2_CID_EXPOSURE_ABSOLUTE


@dataclass(frozen=True)
class ControlMeaning:
    """Which controls a setting is.

    ``automatic`` is the control of its automatic, ``off`` that control's value for off.
    """

    name: str
    word: str
    automatic: int
    off: int
    control: int
    unit: float = 1.0

    def counts(self, value: float) -> int:
        """Return a value in the device's own counts."""
        return round(value / self.unit)


EXPOSURE = ControlMeaning(
    "exposure_s",
    "exposure",
    abi.CID_EXPOSURE_AUTO,
    abi.EXPOSURE_MANUAL,
    abi.CID_EXPOSURE_ABSOLUTE,
    EXPOSURE_UNIT_S,
)
MEANINGS = (
    EXPOSURE,
    ControlMeaning("gain", "gain", abi.CID_AUTOGAIN, 0, abi.CID_GAIN),
    ControlMeaning(
        "white_balance_k", "white balance", abi.CID_AUTO_WHITE_BALANCE, 0, abi.CID_WHITE_BALANCE_TEMPERATURE
    ),
    ControlMeaning("focus", "focus", abi.CID_FOCUS_AUTO, 0, abi.CID_FOCUS_ABSOLUTE),
)


def is_automatic(node: Node, controls: Sequence[CameraControl], one: ControlMeaning) -> bool:
    """Return whether the camera itself sets it now."""
    automatic = first_of(controls, (one.automatic,))
    return automatic is not None and get_value(node, automatic) not in (one.off, None)


def value_of(node: Node, controls: Sequence[CameraControl], one: ControlMeaning) -> float | None:
    """Return what is set now; None if the camera has no such control, or sets it itself."""
    control = first_of(controls, (one.control,))
    if control is None or is_automatic(node, controls, one):
        return None
    counts = get_value(node, control)
    return None if counts is None else counts * one.unit


def settings_of(node: Node, options: CameraOptions, period_s: float | None) -> list[CameraSetting]:
    """Return what of a camera may be changed, as it is now.

    ``period_s`` is from frame to frame and bounds an exposure; None if the camera does not say.
    """
    controls, found = list_controls(node), []
    for one in MEANINGS:
        if (control := first_of(controls, (one.control,))) is None:
            continue
        lowest, highest = control.minimum * one.unit, control.maximum * one.unit
        if one is EXPOSURE and period_s is not None:  # in whole steps, or rounding would exceed it
            whole_s = math.floor(period_s / one.unit + 1e-6) * one.unit
            highest = max(lowest, min(highest, whole_s))
        found.append(
            CameraSetting(
                one.name,
                value_of(node, controls, one),
                lowest,
                highest,
                control.step * one.unit,
                is_automatic(node, controls, one),
                _refusal(one, options),
            )
        )
    return found


def _refusal(one: ControlMeaning, options: CameraOptions) -> str:
    """Why a setting is not to be changed at run time."""
    if one is EXPOSURE and options.auto_exposure is not None:
        return "is set by 'auto_exposure' of the camera's options"
    if one.name == "focus" and options.focus is None:
        return "is not in the camera's options, so no restart could come back to the calibrated one"
    return ""


def change(
    node: Node,
    wanted: Mapping[str, float],
    in_force: Mapping[str, ValuesSet],
    clock: Clock,
    device: str,
) -> tuple[dict[str, float], list[str], DriverError | None]:
    """Change settings one after the other, as `change_each`."""
    controls = list_controls(node)
    meanings = {one.name: one for one in MEANINGS if first_of(controls, (one.control,)) is not None}
    known = {name: values for name, values in in_force.items() if name in meanings}

    def set_one(name: str, value: float) -> tuple[float | None, str, str]:
        one = meanings[name]
        control, automatic = (first_of(controls, (number,)) for number in (one.control, one.automatic))
        assert control is not None
        problem, was, left = None, None, ""
        if automatic is not None:
            was = get_value(node, automatic)
            problem = set_value(node, automatic, one.off)
        counts = min(max(one.counts(value), control.minimum), control.maximum)
        problem = problem or set_value(node, control, counts)
        refused = problem is not None and problem.became is None
        # A refused value leaves the automatic as it was.
        if refused and automatic and was is not None and set_value(node, automatic, was) is not None:
            left = f"; {automatic.name} stays {one.off}"
        reason = f"{problem.message}{left}" if refused and problem is not None else ""
        return value_of(node, controls, one), reason, f"; the camera has steps of {control.step * one.unit:g}"

    ordered = [(one.name, wanted[one.name]) for one in MEANINGS if one.name in wanted]
    return change_each(ordered, known, set_one, clock.now_s, device)


def with_settings(options: CameraOptions, became: Mapping[str, float]) -> CameraOptions:
    """Return the options that open the camera as it is now."""
    whole = {name: round(value) for name, value in became.items() if name != EXPOSURE.name}
    exposure_s = became.get(EXPOSURE.name, options.exposure_s)
    return options.model_copy(update={**whole, EXPOSURE.name: exposure_s})
