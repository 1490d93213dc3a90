"""Places of the head that people keep by a name: on the daemon's disk, so for everybody and every day."""

from __future__ import annotations

import math
import threading
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

from calib.errors import BadFile
from mastctl.answers import PlacesTold, PlaceTold
from mastctl.errors import BadRequest, NotKnown, Unable
from mastctl.safety.state_file import StateFile

FILE = "places.json"
SCHEMA = "mastctl/places/1"
HOME = "home"
MOST = 50


class KeptPlace(NamedTuple):
    """Pan and tilt as the head reads them, radians."""

    pan_rad: float
    tilt_rad: float

    def told(self) -> PlaceTold:
        """Return it as JSON."""
        return {"pan_rad": self.pan_rad, "tilt_rad": self.tilt_rad}


AT_HOME = KeptPlace(0.0, 0.0)
"""Home, until somebody keeps another one."""


class Places:
    """The kept places of one daemon; safe to use from any thread.

    Each call reads the disk: few ask, and what was kept by hand is seen too.

    Parameters
    ----------
    folder
        Where the daemon's state is kept.
    """

    def __init__(self, folder: Path) -> None:
        self._file = StateFile(folder / FILE, SCHEMA)
        self._writing = threading.Lock()

    def told(self) -> PlacesTold:
        """Return every place by its name as JSON, home first. Raises Unable ``unreadable``."""
        kept = self._read()
        ordered = {HOME: kept.pop(HOME, AT_HOME), **dict(sorted(kept.items()))}
        return {"places": {name: place.told() for name, place in ordered.items()}}

    def keep(self, name: str, place: KeptPlace) -> PlacesTold:
        """Keep a place by a name, in the place of a former one, and return all.

        Raises
        ------
        BadRequest
            ``too_many_places``.
        Unable
            ``unreadable``, ``not_saved``.
        """
        with self._writing:
            kept = self._read()
            if name not in kept and len(kept) >= MOST:
                raise BadRequest(
                    "too_many_places", f"{MOST} places are kept already; forget one of them first"
                )
            self._write({**kept, name: place})
        return self.told()

    def forget(self, name: str) -> PlacesTold:
        """Forget a place and return all that are left; a forgotten home is 0, 0 again.

        Raises
        ------
        NotKnown
            ``place_unknown``.
        Unable
            ``unreadable``, ``not_saved``.
        """
        with self._writing:
            kept = self._read()
            if name not in kept:
                raise NotKnown("place_unknown", f"no place is kept by the name {name!r}")
            self._write({one: place for one, place in kept.items() if one != name})
        return self.told()

    def _read(self) -> dict[str, KeptPlace]:
        try:
            document = self._file.read() or {}
            places = document.get("places", {})
            return {name: _place(one) for name, one in places.items()}
        except BadFile as error:
            raise Unable("unreadable", str(error)) from None
        except (AttributeError, KeyError, TypeError, ValueError) as error:
            words = f"{self._file.path}: places: {error!r} where pan_rad and tilt_rad of each are expected"
            raise Unable("unreadable", words) from None

    def _write(self, places: Mapping[str, KeptPlace]) -> None:
        try:
            self._file.write({"places": {name: place.told() for name, place in places.items()}})
        except BadFile as error:
            raise Unable("not_saved", str(error)) from None


def _place(told: Any) -> KeptPlace:
    """A place as it was written. Raises KeyError, TypeError, ValueError."""
    place = KeptPlace(float(told["pan_rad"]), float(told["tilt_rad"]))
    if not all(map(math.isfinite, place)):
        raise ValueError(f"{place} is not finite")
    return place
