"""The kernel's own word that a video node came or went (NETLINK_KOBJECT_UEVENT), where it can be had."""

from __future__ import annotations

import errno
import socket
from dataclasses import dataclass

_NETLINK_KOBJECT_UEVENT = 15
_KERNEL_GROUP = 1
_LARGEST_BYTES = 16384


@dataclass(frozen=True)
class Uevent:
    """``action`` is add, remove, change; ``node`` the name under /dev."""

    action: str
    node: str


class UeventSocket:
    """Hears of video nodes. `available` is False where the kernel or a container does not allow it."""

    def __init__(self) -> None:
        self._socket: socket.socket | None = None
        family = getattr(socket, "AF_NETLINK", None)
        if family is None:
            return
        try:
            opened = socket.socket(family, socket.SOCK_DGRAM | socket.SOCK_NONBLOCK, _NETLINK_KOBJECT_UEVENT)
        except OSError:
            return
        try:
            opened.bind((0, _KERNEL_GROUP))
        except OSError:
            opened.close()
            return
        self._socket = opened

    @property
    def available(self) -> bool:
        return self._socket is not None

    def fileno(self) -> int:
        """Return the descriptor, for poll; -1 where there is none."""
        return self._socket.fileno() if self._socket is not None else -1

    def read(self) -> list[Uevent]:
        """Return what was told since the last call, about video nodes only."""
        found: list[Uevent] = []
        while self._socket is not None:
            try:
                message, sender = self._socket.recvfrom(_LARGEST_BYTES)
            except BlockingIOError:
                break
            except OSError as error:
                if error.errno == errno.ENOBUFS:
                    continue  # the queue ran over; what follows is still worth reading
                break
            if sender[0] == 0 and (event := parse(message)) is not None:  # 0: from the kernel itself
                found.append(event)
        return found

    def close(self) -> None:
        if self._socket is not None:
            self._socket.close()
            self._socket = None


def parse(message: bytes) -> Uevent | None:
    """Return what a message says of a video node, None if it is about something else."""
    words = message.split(b"\0")
    pairs = dict(word.split(b"=", 1) for word in words if b"=" in word)
    if pairs.get(b"SUBSYSTEM") != b"video4linux":
        return None
    node = pairs.get(b"DEVNAME", b"").decode(errors="replace").rpartition("/")[2]
    return Uevent(pairs.get(b"ACTION", b"").decode(errors="replace"), node)
