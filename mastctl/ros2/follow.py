"""Threads that follow the daemon - its events, its pictures, its status - and begin again when it is gone."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable, Sequence
from typing import Any

from mastctl.client import Client, ClientError
from mastctl.client.pictures import LivePicture
from mastctl.ros2.times import ClockExchange, real_from_monotonic_ns

log = logging.getLogger(__name__)

AGAIN_S = 1.0
STATUS_S = 1.0
LOOK_S = 0.1  # how often it is seen whether somebody subscribes
TOPICS = ("joints", "operation", "mast")


class Following:
    """Threads that each speak with the daemon through a client of their own, until `close`.

    Parameters
    ----------
    connect
        Makes a client.
    """

    def __init__(self, connect: Callable[[], Client]) -> None:
        self._connect = connect
        self._over = threading.Event()
        self._threads: list[threading.Thread] = []

    def status(
        self, tell: Callable[[dict[str, Any], ClockExchange], None], lost: Callable[[str], None]
    ) -> None:
        """Have the status told once a second, with the exchange of times; ``lost`` gets why there is none."""

        def work(client: Client) -> None:
            while not self._over.is_set():
                sent_s = time.monotonic()
                told = client.status()
                got_s = time.monotonic()
                tell(dict(told), ClockExchange(sent_s, told["now_s"], got_s, real_from_monotonic_ns()))
                self._over.wait(STATUS_S)

        self._begin("status", work, lost)

    def events(self, tell: Callable[[str, str, Any], None]) -> None:
        """Have joints, operations and the mast file told at each change, as topic, key, value."""

        def work(client: Client) -> None:
            for event in client.events(*TOPICS):
                tell(event["topic"], event["key"], event["value"])
                if self._over.is_set():
                    return

        self._begin("events", work)

    def pictures(
        self, cameras: Sequence[str], wanted: Callable[[str], bool], tell: Callable[[LivePicture], None]
    ) -> None:
        """Have pictures told of those cameras that are wanted when they come."""

        def work(client: Client) -> None:
            with client.live_pictures(*cameras) as line:
                idle = set(cameras)
                while not self._over.is_set():
                    for camera in [one for one in idle if wanted(one)]:
                        idle.discard(camera)
                        line.wanted(camera)
                    picture = line.next(LOOK_S)
                    if picture is None:
                        continue
                    camera = str(picture.facts["camera"])
                    if wanted(camera):
                        line.wanted(camera)  # before it is published: the next one is on its way meanwhile
                        tell(picture)
                    else:
                        idle.add(camera)

        self._begin("pictures", work)

    def close(self) -> None:
        """End the threads; one that waits for the daemon is left to itself."""
        self._over.set()
        for thread in self._threads:
            thread.join(2.0 * LOOK_S)

    def _begin(
        self, name: str, work: Callable[[Client], None], lost: Callable[[str], None] = lambda why: None
    ) -> None:
        thread = threading.Thread(target=self._again, args=(name, work, lost), name=name, daemon=True)
        self._threads.append(thread)
        thread.start()

    def _again(self, name: str, work: Callable[[Client], None], lost: Callable[[str], None]) -> None:
        """Do a work; when the daemon is lost, again when it is there."""
        told = ""
        while not self._over.is_set():
            try:
                with self._connect() as client:
                    work(client)
            except ClientError as error:
                if str(error) != told and not self._over.is_set():
                    log.warning("%s: %s", name, error)
                told = str(error)
                lost(told)
            except Exception:  # a defect must not end the thread
                if self._over.is_set():
                    return
                log.exception("%s met a defect of the program", name)
            self._over.wait(AGAIN_S)
