"""From the publisher to the recorder: a thread that hands on each new value, frames with their pictures."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable
from typing import Any

from mastctl.control.publisher import TOPICS, Publisher, ThreadSubscription, Topic
from mastctl.devices.frames import StampedFrame
from mastctl.errors import MastctlError
from mastctl.recorder.recorder import Recorder

log = logging.getLogger(__name__)

CLOSE_S = 1.0
ELSEWHERE: frozenset[Topic] = frozenset({"bench"})
"""What is not recorded here: a run's own folder has all of it."""


class Feed:
    """Tells a recorder what is published until it is closed, or the publisher is.

    Parameters
    ----------
    publisher, recorder
        From where to where.
    frame_by_id
        Finds a kept frame; raises MastctlError if it is kept no longer.
    """

    def __init__(
        self, publisher: Publisher, recorder: Recorder, frame_by_id: Callable[[str], StampedFrame]
    ) -> None:
        self._recorder = recorder
        self._frame_by_id = frame_by_id
        self._news = publisher.subscribe(*(TOPICS - ELSEWHERE))
        self._thread = threading.Thread(
            target=self._work, args=(self._news,), name="recorder feed", daemon=True
        )
        self._thread.start()

    def close(self) -> None:
        """Hand on nothing more."""
        self._news.close()
        self._thread.join(CLOSE_S)

    def _work(self, news: ThreadSubscription) -> None:
        lost = 0
        while True:
            found = news.wait()
            for one in found:
                self._hand_on(one.topic, one.key, one.value)
            if news.lost > lost:
                self._recorder.missed("overtaken", news.lost - lost)
                lost = news.lost
            if not found and news.closed:
                return

    def _hand_on(self, topic: str, key: str, value: Any) -> None:
        if topic == "frame" and not isinstance(value, StampedFrame):
            try:
                value = self._frame_by_id(value["frame_id"] if isinstance(value, dict) else value.frame_id)
            except MastctlError:
                self._recorder.missed("frame", 1)
                return
        self._recorder.tell(topic, key, value)
