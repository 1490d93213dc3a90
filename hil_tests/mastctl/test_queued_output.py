"""Words for stderr and stdout: nobody waits for whoever reads them."""

from __future__ import annotations

import logging
import signal
import threading
from pathlib import Path

import pytest

from hil_tests.mastctl.outside_daemon import (
    Pipe,
    answers,
    daemon_process,
    free_port,
    stands_short_of_its_goal,
    under_way,
    write_config,
)
from hil_tests.mastctl.service_fakes import Hang
from hil_tests.waiting import NET_S, until
from mastctl.client import Client
from mastctl.logs import QueuedHandler, QueuedText, QueuedWriter, stall_while


@pytest.mark.parametrize("full", ["stderr", "stdout", "both"])
def test_a_full_pipe_for_its_words_does_not_hold_a_stop(tmp_path: Path, full: str) -> None:
    url = f"http://127.0.0.1:{(port := free_port())}"
    config = write_config(tmp_path, f"{{port: {port}}}")
    out, log = Pipe(), Pipe()
    for name, pipe in (("stdout", out), ("stderr", log)):
        if full in (name, "both"):
            pipe.fill()
    with daemon_process(tmp_path, config, stdout=out.write, stderr=log.write) as daemon:
        until(lambda: answers(url), "the daemon's first answer")
        with Client(url, timeout_s=NET_S) as client:
            under_way(client)
            assert client.stop()["stopped"] is True
            stands_short_of_its_goal(client)
        daemon.send_signal(signal.SIGTERM)
        assert daemon.wait(NET_S) == 0
    assert (tmp_path / "head.log").read_text().splitlines()[-1] == "close"


def test_what_does_not_fit_is_dropped_and_counted_and_said_when_it_flows_again() -> None:
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


def test_a_stall_that_was_ordered_is_as_a_pipe_that_nobody_reads() -> None:
    pipe, reads = Pipe(), threading.Event()
    writer = QueuedWriter(pipe.write, kept=10)
    stall_while(lambda: not reads.is_set())
    try:
        for number in range(100):
            writer.put(f"word {number}\n")
        assert not writer.flush(0.1)
        reads.set()
        told = pipe.drain(b"dropped").decode()
    finally:
        stall_while(lambda: False)
    assert f"{100 - told.count('word')} messages were dropped" in told and told.count("word") <= 12


def test_words_need_no_lock_of_the_handler_in_any_python(monkeypatch: pytest.MonkeyPatch) -> None:
    def since_3_13(self: logging.Handler, record: logging.LogRecord) -> bool:
        assert self.lock is not None, "'with None' is a TypeError in whoever logs"
        with self.lock:
            self.emit(record)
        return True

    monkeypatch.setattr(logging.Handler, "handle", since_3_13)
    pipe = Pipe()
    handler = QueuedHandler(QueuedWriter(pipe.write))
    handler.addFilter(lambda record: record.msg != "left out")
    for words in ("left out", "said"):
        handler.handle(logging.makeLogRecord({"msg": words}))
    assert pipe.drain(b"said") == b"said\n"


def test_words_that_take_for_ever_to_be_made_hold_only_the_thread_that_writes() -> None:
    pipe, hang = Pipe(), Hang()

    class Slow:
        def __str__(self) -> str:
            hang()
            return "at last"

    handler = QueuedHandler(QueuedWriter(pipe.write))
    handler.handle(logging.makeLogRecord({"msg": "%s", "args": (Slow(),)}))
    handler.handle(logging.makeLogRecord({"msg": "%d", "args": ("no number",)}))
    handler.handle(logging.makeLogRecord({"msg": "next"}))
    assert hang.entered.wait(NET_S)
    hang.let_go()
    told = pipe.drain(b"next").decode()
    assert told.splitlines() == [
        "at last",
        "mastctl: a message could not be put into words: TypeError",
        "next",
    ]
