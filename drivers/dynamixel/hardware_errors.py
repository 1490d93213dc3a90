"""A servo's hardware error: its words, and how often the servo may be rebooted for it. No I/O."""

from __future__ import annotations

from drivers.dynamixel.models import HARDWARE_ERRORS, hardware_error_words

MOST_REBOOTS, REBOOT_SPAN_S = 3, 600.0


class Reboots:
    """When the servos of a head were rebooted: `MOST_REBOOTS` times in `REBOOT_SPAN_S` at most.

    Counted over all lines of the head, where a servo is rebooted and nowhere else.
    """

    def __init__(self) -> None:
        self._times_s: list[float] = []

    def left(self, now_s: float) -> int:
        """Return how many may be done now."""
        self._times_s = [then_s for then_s in self._times_s if now_s - then_s < REBOOT_SPAN_S]
        return MOST_REBOOTS - len(self._times_s)

    def note(self, now_s: float) -> None:
        """Count one."""
        self._times_s.append(now_s)


def hardware_fault_words(name: str, error: int) -> str:
    """Return one sentence for a hardware error."""
    words = " and ".join(hardware_error_words(error & sum(HARDWARE_ERRORS)) or [f"bits 0x{error:02x}"])
    return (
        f"{name} reports {words} (hardware error 0x{error:02x}); it keeps saying so until it is rebooted or "
        "switched off and on, which drops its torque"
    )
