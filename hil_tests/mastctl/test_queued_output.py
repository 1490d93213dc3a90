"""Texts for stderr and stdout: no caller waits for their reader."""

from __future__ import annotations

import logging
import signal

from hil_tests.mastctl.outside_daemon import Pipe
from mastctl.logs import QueuedHandler, QueuedText


def test_texts_that_do_not_fit_are_dropped_and_counted_in_the_log() -> None:
    pipe = Pipe()
    pipe.fill()
    stream = QueuedText(pipe.write, kept=10)
    handler = QueuedHandler(stream)
    logger = logging.getLogger("mastctl.logs")
    logger.addHandler(handler)
    try:
        for number in range(100):
            handler.handle(logging.makeLogRecord({"msg": "number %d", "args": (number,)}))
        text = pipe.drain(b"dropped").decode()
    finally:
        logger.removeHandler(handler)
    kept = text.count("number")
    assert 10 <= kept <= 12, "those in the queue, and one or two that the writing thread has taken"
    assert f"{100 - kept} messages were dropped" in text
    stream.write("again\n")
    assert stream.written()
    assert b"again" in pipe.drain(b"again")


def test_a_text_may_be_written_while_its_thread_is_writing_one() -> None:
    pipe = Pipe()
    stream = QueuedText(pipe.write, kept=1_000_000)

    def interrupted(number: int, frame: object) -> None:  # anywhere, also inside the queue
        stream.write("x")

    before = signal.signal(signal.SIGALRM, interrupted)
    signal.setitimer(signal.ITIMER_REAL, 1e-4, 1e-4)
    try:
        for _ in range(20_000):
            stream.write("")
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0.0)
        signal.signal(signal.SIGALRM, before)
    stream.write("end\n")
    assert b"x" in pipe.drain(b"end")
