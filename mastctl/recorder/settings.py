"""What a configuration says about recording."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field

from calib.files.records import ABSENT, PathInFile, Record

RING_S = 300.0
"""Of real hardware, unless the configuration says otherwise: five minutes before a fault."""


_Megabytes = Annotated[float, Field(ge=10.0, le=1e7)]


class RecordSettings(Record):
    """How much is recorded, 1 MB being 10⁶ bytes, and where.

    Without ``ring_s`` the ring is `RING_S` long if any device is real, and there is none otherwise; without
    ``folder`` recordings lie in ``records`` in the daemon's state folder.
    """

    ring_s: Annotated[float, Field(ge=0.0, le=86400.0)] = Field(
        default=ABSENT, description="length of the ring that is kept at a fault; 0: none (Recording)"
    )
    ring_mb: _Megabytes = Field(default=1000.0, description="most of the ring")
    kept_mb: _Megabytes = Field(
        default=4000.0, description="most of the recordings kept at faults; the oldest is deleted first"
    )
    run_mb: _Megabytes = Field(default=4000.0, description="most of one run; it ends there")
    free_mb: _Megabytes = Field(
        default=1000.0, description="free space kept on the disk; nothing is recorded below"
    )
    folder: PathInFile = Field(default=ABSENT, description="where recordings lie")

    def ring_of(self, hardware: str) -> float:
        """Return how long back the ring goes for hardware of a kind (`drivers.hardware.Hardware.kind`)."""
        if self.ring_s is not None:
            return self.ring_s
        return RING_S if hardware in ("real", "mixed") else 0.0
