"""What belongs to the faults of a device's calls."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class FaultWords:
    """What belongs to the faults of one kind of call.

    Attributes
    ----------
    until
        What takes such a fault back, in plain words that follow "until".
    late_is_fault
        Whether an answer that came too late is a fault itself, because the call moves something; any other
        answer, however late, shows that the device works again.
    """

    until: str
    late_is_fault: bool = False
