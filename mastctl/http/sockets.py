"""WebSockets that tell: whatever a client sends into one, and however it reads, costs nobody anything.

uvicorn's protocol answers pings without waiting for its client to read, keeps what is sent to it, and bounds
neither. Here a message from the client ends the connection with its first frame, pings are answered only
while their answers are read, and a client that takes no bytes for some seconds is left. Where pictures are
told, a client says by short words which of them it has shown, and asks for the time.
"""

from __future__ import annotations

import logging
from collections.abc import Callable
from typing import Any

from uvicorn.protocols.utils import ClientDisconnected
from uvicorn.protocols.websockets.websockets_sansio_impl import WebSocketsSansIOProtocol
from websockets.frames import Frame
from websockets.protocol import State

from mastctl.http.connections import IMAGES, let_in

log = logging.getLogger(__name__)
log.setLevel(logging.ERROR)
log.addFilter(lambda record: "without completing handshake" not in record.msg)  # it was refused

LARGEST_BYTES = 1024  # of what a client sends; it has nothing to say
PING_S = 20.0
STALLED_S = 10.0
MOST_PINGS = 20  # of a client in a second
LONGEST_WORD = 100  # a camera's name, and how large its next picture may be
MOST_WORDS = 400  # in a second: what six cameras at 30 frames/s need, twice
UNSUPPORTED, BROKEN_RULES = 1003, 1008  # RFC 6455, 7.4.1


class Socket(WebSocketsSansIOProtocol):
    """One WebSocket, which knows for how long its client has not read."""

    waits = False
    waits_since_s = 0.0

    def __init__(self, *args: Any, **options: Any) -> None:
        super().__init__(*args, **options)
        self.logger = self.conn.logger = log  # what strangers send is no warning
        self._stalled_since_s: float | None = None
        self._pings, self._words, self._second = 0, 0, 0

    def overdue(self, now_s: float) -> bool:
        """Whether its client has not read for too long."""
        if self._stalled_since_s is None and self.transport.is_closing():
            self._stalled_since_s = now_s  # its last words are waiting to be read
        return self._stalled_since_s is not None and now_s - self._stalled_since_s > STALLED_S

    def leave(self) -> None:
        """Close it at once, whatever its client still expects."""
        self.transport.abort()

    def end_reading(self, stands: Callable[[str], bool]) -> None:
        """Close it if its credential lets in no more."""
        if self.handshake_complete and not let_in(self.scope, stands):
            self._end(BROKEN_RULES, "the token that opened this has ended")

    def shutdown(self) -> None:
        """As uvicorn asks of all when the daemon ends: who tells here ends too, and says goodbye first."""
        if self.close_sent or not self.handshake_complete:
            super().shutdown()

    def pause_writing(self) -> None:
        super().pause_writing()
        self._stalled_since_s = self.loop.time()
        self.transport.pause_reading()

    def resume_writing(self) -> None:
        super().resume_writing()
        self._stalled_since_s = None
        self.transport.resume_reading()

    async def send(self, message: Any) -> None:
        """Send; raises ClientDisconnected also where the connection is ending already."""
        await self.writable.wait()
        if self.handshake_complete and self.close_sent:
            raise ClientDisconnected
        await super().send(message)

    def handle_text(self, event: Frame) -> None:
        if self.scope["path"] != IMAGES:
            self._not_taken(event)
        elif not event.fin or len(event.data) > LONGEST_WORD or not bytes(event.data).isascii():
            self._end(UNSUPPORTED, "CAMERA, CAMERA MOST_BYTES or ? WORDS are taken here")
        elif self._seldom():
            super().handle_text(event)

    def _not_taken(self, event: Frame) -> None:
        self._end(UNSUPPORTED, "this WebSocket sends and takes nothing")

    handle_bytes = handle_cont = _not_taken

    def handle_ping(self) -> None:
        if self._often():
            super().handle_ping()

    def handle_pong(self, event: Frame) -> None:
        if self._often():
            super().handle_pong(event)

    def handle_parser_exception(self) -> None:
        if self.conn.close_sent is None:  # no WebSocket was begun
            self.leave()
        else:
            super().handle_parser_exception()

    def _often(self) -> bool:
        """Count a ping or a pong; False if there are too many, and the connection ends."""
        self._count()
        self._pings += 1
        if self._pings > MOST_PINGS:
            self._end(BROKEN_RULES, f"more than {MOST_PINGS} pings in a second")
        return self._pings <= MOST_PINGS

    def _seldom(self) -> bool:
        """Count a word; False if there are too many, and the connection ends."""
        self._count()
        self._words += 1
        if self._words > MOST_WORDS:
            self._end(BROKEN_RULES, f"more than {MOST_WORDS} messages in a second")
        return self._words <= MOST_WORDS

    def _count(self) -> None:
        """Begin to count anew with each second."""
        second = int(self.loop.time())
        if second != self._second:
            self._second, self._pings, self._words = second, 0, 0

    def _end(self, code: int, words: str) -> None:
        if self.close_sent or self.conn.state is not State.OPEN:  # it ends already
            return
        self.close_sent = True
        self.conn.send_close(code, words)
        self.transport.write(b"".join(self.conn.data_to_send()))
        self.queue.put_nowait({"type": "websocket.disconnect", "code": code, "reason": words})
        self.transport.close()
