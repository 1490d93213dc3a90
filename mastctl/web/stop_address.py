"""Which requests stop something, in whatever way their address is written.

A stop is not refused for a slash too many, nor for naming its host in front as a client of a proxy does.
Everything else has one address.
"""

from __future__ import annotations

import re

from starlette.types import Scope

from mastctl.web import PREFIX

STOPS = frozenset({f"{PREFIX}/stop", f"{PREFIX}/estop"})
"""What everybody may ask for who reaches the daemon, whatever else the request says."""
TRACK_STOP = f"{PREFIX}/track/stop"

_WRITTEN = "(?:(?i:https?)://[^/ ]*)?" + "/+".join(["", *PREFIX.split("/")[1:], "(stop|estop|track/+stop)/*"])
_ADDRESS = re.compile(_WRITTEN)
STOP_LINE = re.compile(f"POST {_WRITTEN}[ ?]".encode())
"""How a request begins that stops something; everything else is read in turn."""


def stop_named(scope: Scope) -> Scope:
    """Return a request with the one address of the stop that it asks for; any other as it is."""
    written = _ADDRESS.fullmatch(scope["path"]) if scope["method"] == "POST" else None
    if written is None:
        return scope
    name = TRACK_STOP if written[1].startswith("track") else f"{PREFIX}/{written[1]}"
    return {**scope, "path": name}
