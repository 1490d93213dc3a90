"""Goals that a head of any driver accepts."""

from __future__ import annotations

from collections.abc import Sequence

from drivers.errors import OutOfRange


def check_goal(
    angles_rad: Sequence[float],
    limits_rad: Sequence[tuple[float, float]],
    speed_rad_per_s: float | None,
    device: str = "",
) -> None:
    """Pass pan and tilt within their limits, and a speed above zero or none. Raises OutOfRange."""
    if speed_rad_per_s is not None and not speed_rad_per_s > 0:
        raise OutOfRange(f"speed {speed_rad_per_s} rad/s is not a positive number", device=device)
    for name, angle, (low, high) in zip(("pan", "tilt"), angles_rad, limits_rad, strict=True):
        if not low <= angle <= high:
            words = f"{name} {angle:.4f} rad is outside the head's limits {low:.4f} to {high:.4f} rad"
            raise OutOfRange(words, device=device)
