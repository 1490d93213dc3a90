"""What a person means by a camera's name at the command line, and the options that open it as it is set."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from drivers.errors import DriverError
from drivers.v4l2.controls import Value
from drivers.v4l2.errors import NoCamera, UnsupportedFormat
from drivers.v4l2.find import list_cameras
from drivers.v4l2.node import Node
from drivers.v4l2.pixels import FORMATS


def options_for(
    word: str,
    code: str | None,
    size_px: tuple[int, int] | None,
    rate_hz: float | None,
    controls: Mapping[str, Value],
) -> dict[str, Any]:
    """Return options for `open_camera` from a link, a node, a card name or a bus.

    A node's number is good for now, so here, where a person just read it, it is taken and turned into card
    and bus. What is not given stays as the camera has it: size and rate, and the format if it can be read.

    Raises
    ------
    NoCamera
        If nothing of that name is connected.
    DriverError
        If it cannot be opened or has no format that can be read.
    """
    path = _node_path(word)
    with Node(path, word) as node:
        now = node.current_format()
        if code is None:
            offered = [now.code, *node.formats()]
            code = next((c for c in offered if c in FORMATS), None)
            if code is None:
                raise UnsupportedFormat(
                    f"the camera has only formats that are not read: {', '.join(offered)}", device=word
                )
        who = node.identity
        address = (
            {"device": word}
            if path == Path(word) and path.is_symlink()
            else {"bus": who.bus, "card": who.card}
        )
    size_px = now.size_px if size_px is None else size_px
    options: dict[str, Any] = {
        **address,
        "format": code,
        "size_px": list(size_px),
        "controls": dict(controls),
    }
    options["rate_hz"] = rate_hz
    return options


def _node_path(word: str) -> Path:
    """The node that a word means now."""
    if "/" in word:
        return Path(word)
    matches = [c for c in list_cameras() if word in (c.card, c.bus)]
    if len(matches) == 1:
        return matches[0].node
    connected = ", ".join(f"{c.card!r} at {c.bus}" for c in list_cameras()) or "none"
    if matches:
        busses = ", ".join(c.bus for c in matches)
        raise DriverError(f"several cameras have this name; give a bus instead: {busses}", device=word)
    raise NoCamera(f"no camera of this card or bus is connected; connected are {connected}", device=word)
