"""Words for stderr and stdout: nobody waits for whoever reads them."""

from __future__ import annotations

import logging

from hil_tests.mastctl.outside_daemon import (
    Pipe,
)
from hil_tests.waiting import NET_S
from mastctl.logs import QueuedHandler, QueuedText, QueuedWriter


def test_what_does_not_fit_is_dropped_and_counted_and_said_later() -> None:
    pipe = Pipe()
    pipe.fill()
    writer = QueuedWriter(pipe.write, kept=10)
    handler = QueuedHandler(writer)
    for number in range(100):
        handler.handle(logging.makeLogRecord({"msg": "word %d", "args": (number,)}))
    told = pipe.drain(b"dropped").decode()
    kept = told.count("word")
    assert 10 <= kept <= 12, "those in the queue, and one or two in the writing thread's hands"
    assert f"{100 - kept} messages were dropped" in told
    QueuedText(writer).write("again\n")
    assert writer.flush(NET_S)
    assert b"again" in pipe.drain(b"again")
