"""Places of the head that people keep by a name, on the daemon's disk."""

from __future__ import annotations

import math
import threading
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from calib.errors import BadFile
from mastctl.answers import HeadPlace, PlaceList
from mastctl.errors import BadRequest, NotKnown, Unable
from mastctl.safety.state_folder import StateFile

FILE = "places.json"
SCHEMA = "mastctl/places/1"
HOME = "home"
MOST = 50


AT_HOME: HeadPlace = {"pan_rad": 0.0, "tilt_rad": 0.0}
"""Home, until somebody keeps another one."""


class Places:
    """The kept places of one daemon; safe to use from any thread.

    Each call reads the disk: there are few, and what was kept by hand is seen too.
    """

    def __init__(self, folder: Path) -> None:
        self._file = StateFile(folder / FILE, SCHEMA)
        self._writing = threading.Lock()

    def all(self) -> PlaceList:
        """Return every place by its name as JSON, home first. Raises Unable ``unreadable``."""
        kept = self._read()
        ordered = {HOME: kept.pop(HOME, AT_HOME), **dict(sorted(kept.items()))}
        return {"places": ordered}

    def keep(self, name: str, place: HeadPlace) -> PlaceList:
        """Keep a place by a name, in the place of a former one, and return all.

        Raises BadRequest ``too_many_places``; Unable ``unreadable``, ``not_saved``.
        """
        with self._writing:
            kept = self._read()
            if name not in kept and len(kept) >= MOST:
                raise BadRequest(
                    "too_many_places", f"{MOST} places are kept already; forget one of them first"
                )
            self._write({**kept, name: place})
        return self.all()

    def forget(self, name: str) -> PlaceList:
        """Forget a place and return all that are left; a forgotten home is 0, 0 again.

        Raises NotKnown ``place_unknown``; Unable ``unreadable``, ``not_saved``.
        """
        with self._writing:
            kept = self._read()
            if name not in kept:
                raise NotKnown("place_unknown", f"no place is kept by the name {name!r}")
            self._write({one: place for one, place in kept.items() if one != name})
        return self.all()

    def _read(self) -> dict[str, HeadPlace]:
        try:
            document = self._file.read() or {}
            places = document.get("places", {})
            return {name: _place(one) for name, one in places.items()}
        except BadFile as error:
            raise Unable("unreadable", str(error)) from None
        except (AttributeError, KeyError, TypeError, ValueError) as error:
            message = f"{self._file.path}: places: {error!r} where pan_rad and tilt_rad of each are expected"
            raise Unable("unreadable", message) from None

    def _write(self, places: Mapping[str, HeadPlace]) -> None:
        try:
            self._file.write({"places": dict(places)})
        except BadFile as error:
            raise Unable("not_saved", str(error)) from None


def _place(kept: Any) -> HeadPlace:
    """A place as it was written. Raises KeyError, TypeError, ValueError."""
    place: HeadPlace = {"pan_rad": float(kept["pan_rad"]), "tilt_rad": float(kept["tilt_rad"])}
    if not (math.isfinite(place["pan_rad"]) and math.isfinite(place["tilt_rad"])):
        raise ValueError(f"{place} is not finite")
    return place
