"""Looking again and again, at the reference's hour, whenever the head is idle; giving way to everybody."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from contextlib import AbstractContextManager
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from calib.calibrate.scene.drift import SceneDrift
from calib.errors import BadFile
from mastctl.client import Client, ClientError
from mastctl.errors import MastctlError
from mastctl.sentinel.folder import Reference, add_look, read_looks, read_reference
from mastctl.sentinel.look import LookEnded, is_idle, look_again

LEASE_S = 30.0
RETRY_S = 60.0
"""After so long it is tried again, where a look is due and somebody needs the head, or had it given up."""

NAME = "sentinel"


def now_utc() -> datetime:
    """Return the time of day."""
    return datetime.now(UTC)


def is_due(reference: Reference, last_look: str | None, every_s: float, now: datetime) -> bool:
    """Return whether a look is due: at the reference's time of day, and each ``every_s`` from it on.

    What a clock that was set back makes of it is a look too many, not none for as long.
    """

    def turn(moment: datetime) -> int:
        passed = moment - datetime.fromisoformat(reference.time).astimezone(UTC)
        return math.floor(passed.total_seconds() / every_s)

    last = reference.time if last_look is None else last_look
    return turn(now) != turn(datetime.fromisoformat(last).astimezone(UTC))


def look_idle(client: Client, reference: Reference) -> SceneDrift:
    """Look under a lease that gives way to everybody.

    Raises
    ------
    LookEnded
        If somebody wanted to steer or stopped the head; as `look_again` else.
    """
    with client.lease(NAME, for_s=LEASE_S, gives_way=True):
        try:
            return look_again(client, reference)
        except ClientError as error:
            if error.code in ("lease_over", "leased"):
                how = str(error).removeprefix("the lease has ended: ").removesuffix("; acquire another")
                raise LookEnded(f"{how}; nothing was kept") from None
            raise


def watch(
    folder: Path,
    connect: Callable[[], AbstractContextManager[Client]],
    tell: Callable[[str], None],
    looked: Callable[[dict[str, Any]], None],
    every_s: float,
    idle_s: float,
    sleep: Callable[[float], None] = time.sleep,
    now: Callable[[], datetime] = now_utc,
) -> None:
    """Look whenever it is due and the head is idle, until interrupted.

    Parameters
    ----------
    folder
        With a reference.
    connect
        To the daemon.
    tell, looked
        Get why there is no look though one is due, each reason once; and each look.
    every_s
        From look to look, seconds, counted from the reference's time on.
    idle_s
        So long nobody must have used the head.

    Raises
    ------
    BadFile
        If there is no reference at the start. What fails later is told, and tried again.
    """
    read_reference(folder)
    said = ""
    while True:
        why = ""
        try:
            reference = read_reference(folder)
            looks = read_looks(folder, reference)
            if is_due(reference, looks[-1]["time"] if looks else None, every_s, now()):
                with connect() as client:
                    why = is_idle(client, idle_s)
                    if not why:
                        drift = look_idle(client, reference)
                        looked(add_look(folder, reference, now().isoformat(timespec="seconds"), drift))
        except (ClientError, MastctlError, BadFile) as error:
            why = str(error)
        if why and why != said:
            tell(f"no look now: {why}")
        said = why
        sleep(min(RETRY_S, every_s / 4.0))
