"""What a configuration says about recording; read strictly by `mastctl.config`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

RING_S = 300.0
"""Of real hardware, unless the configuration says otherwise: five minutes before a fault."""


@dataclass(frozen=True)
class RecordSettings:
    """How much is recorded, and where.

    Attributes
    ----------
    ring_s
        How long back the ring goes; 0: none; None: `RING_S` if any device is real, none otherwise.
    ring_mb, kept_mb, run_mb
        Most of the ring, of all that was kept at faults (the oldest goes first), and of one run; in
        10⁶ bytes.
    free_mb
        What is left free on the disk: recording ends before that, and goes on when there is more again.
    folder
        Where recordings lie; None: ``records`` in the daemon's state folder.
    """

    ring_s: float | None = None
    ring_mb: float = 1000.0
    kept_mb: float = 4000.0
    run_mb: float = 4000.0
    free_mb: float = 1000.0
    folder: Path | None = None

    def ring_of(self, hardware: str) -> float:
        """Return how long back the ring goes for hardware of a kind (`drivers.hardware.Hardware.kind`)."""
        if self.ring_s is not None:
            return self.ring_s
        return RING_S if hardware in ("real", "mixed") else 0.0
