"""Requests that wait for a dead camera end with the daemon."""

from __future__ import annotations

import signal
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

from hil_tests.mastctl.outside_daemon import (
    daemon_process,
    line,
    write_config,
)
from hil_tests.waiting import NET_S, joined, until
from mastctl.client import Client, ClientError


def in_threads(count: int, ask: Callable[[], Any]) -> list[threading.Thread]:
    made = [threading.Thread(target=ask) for _ in range(count)]
    for one in made:
        one.start()
    return made


def test_requests_that_wait_when_the_daemon_ends_are_refused(tmp_path: Path) -> None:
    codes: list[str] = []
    with daemon_process(tmp_path, write_config(tmp_path)) as daemon:
        url = line(daemon)

        def ask() -> None:
            with Client(url) as client:
                try:
                    client.snapshot("navcam_left", fresh=True)
                except ClientError as error:
                    codes.append(error.code)

        asking = in_threads(5, ask)
        until(lambda: codes == ["too_many"], "four wait, and the fifth is refused for it")
        daemon.send_signal(signal.SIGTERM)
        joined(*asking)
        _, log = daemon.communicate(timeout=NET_S)
    assert codes == ["too_many"] + ["closing"] * 4
    assert daemon.returncode == 0, log
    assert not {"Traceback", "ERROR"} & set(log.replace(":", " ").split()), log
    assert "next_frame did not end" not in log, "nobody waited for the picture's own deadline"
