"""Are the configured cameras there, may they be opened, and do they offer what is asked of them?"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from drivers.errors import BadOptions, DriverError
from drivers.v4l2 import find
from drivers.v4l2.node import CameraBusy, NoCamera, NoPermission
from drivers.v4l2.options import parse_options
from mastctl.doctor.findings import Finding


def examine_camera(name: str, options: Mapping[str, Any], *, in_use: bool) -> Finding:
    """Look at one V4L2 camera; no stream is begun.

    Parameters
    ----------
    name
        As the configuration calls it.
    options
        Of the driver ``v4l2``.
    in_use
        Whether a daemon that runs may have it.
    """
    what = f"camera {name}"
    try:
        asked = parse_options(options, name)
        with find.open_node(asked.address, name) as node:
            offered = node.formats()
            who = node.identity
    except BadOptions as error:
        return Finding(what, "bad", str(error), "correct the configuration")
    except NoCamera as error:
        return Finding(what, "bad", str(error), "plug it in; mastctl camera list shows what is connected")
    except NoPermission as error:
        return Finding(what, "bad", str(error), 'sudo usermod -aG video "$USER", then log in again')
    except CameraBusy as error:
        if in_use:
            return Finding(what, "good", str(error))
        return Finding(what, "bad", str(error), "end the program that has it")
    except DriverError as error:
        return Finding(what, "bad", str(error), "mastctl camera check says more")
    if asked.format not in offered:
        words = f"{who.card} at {who.bus} offers {', '.join(offered)} where {asked.format} is configured"
        return Finding(what, "bad", words, "configure one of these")
    return Finding(what, "good", f"{who.card} at {who.bus}, {asked.format}")
