"""The process that a worker's daemons live in: ``python -m mastctl.testing.serve PARENT``.

It takes one JSON order a line on stdin and answers each with one on stdout. It ends when stdin does, and
when the process PARENT is gone: a copy of that process, forked by a test, may hold stdin open. A worker of
pytest-xdist outlives the pytest that made it by many seconds, or by all of a test that sleeps: that pytest is
watched too.
"""

from __future__ import annotations

import json
import logging
import os
import sys
import threading
import time
from pathlib import Path
from typing import IO, Any

PARENT_CHECKED_S = 0.25


def main() -> None:
    """Serve until no client is left."""
    parent = int(sys.argv[1])
    threading.Thread(target=_watch, args=(parent,), name="parent watched", daemon=True).start()
    # Whatever a driver or a library prints is not for the line of answers.
    with os.fdopen(os.dup(0), "rb") as orders, os.fdopen(os.dup(1), "wb") as answers:
        with Path(os.devnull).open("rb") as nothing:
            os.dup2(nothing.fileno(), 0)
        os.dup2(2, 1)
        from mastctl.logs import QueuedHandler, queued

        sys.stdout = sys.stderr = queued(2)  # as `mastctl run` says things
        handler = QueuedHandler(queued(2))
        handler.setFormatter(logging.Formatter("%(asctime)s %(levelname)s %(name)s: %(message)s"))
        logging.getLogger().addHandler(handler)
        for name in ("mastctl", "drivers", "calib"):
            logging.getLogger(name).setLevel(logging.INFO)
        _serve(orders, answers)
    os._exit(0)  # a simulated rover needs no orderly end, and a thread that hangs must not hold this one


def _watch(parent: int) -> None:
    """End with the process that made this one; the system names another parent when that is gone."""
    controller = _parent_of(parent) if "PYTEST_XDIST_WORKER" in os.environ else None
    while os.getppid() == parent and (controller is None or _parent_of(parent) == controller):
        time.sleep(PARENT_CHECKED_S)
    os._exit(1)


def _parent_of(pid: int) -> int | None:
    """The id of a process's parent; None if it is gone."""
    try:
        after_name = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2]
    except OSError:
        return None
    return int(after_name.split()[1])


def _serve(orders: IO[bytes], answers: IO[bytes]) -> None:
    from mastctl.errors import error_body
    from mastctl.testing.daemons import Daemons

    daemons = Daemons()
    for line in orders:
        order: dict[str, Any] = json.loads(line)
        try:
            answer = {"done": daemons.do(order.pop("do"), order)}
        except Exception as error:
            body = error_body(error)
            if body["code"] == "internal":
                logging.getLogger(__name__).exception("an order failed")
            answer = {"error": {"code": body["code"], "message": body["message"]}}
        try:
            answers.write(json.dumps(answer).encode() + b"\n")
            answers.flush()
        except OSError:
            return


if __name__ == "__main__":
    main()
