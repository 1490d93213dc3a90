"""Routes of the places of the head that are kept by a name."""

from __future__ import annotations

from typing import Annotated, Any

from fastapi import FastAPI, Path

from mastctl.commands.entry import PLACE_FORGET, PLACE_KEEP
from mastctl.service.places import Place
from mastctl.web import PREFIX
from mastctl.web.commands import Headers
from mastctl.web.models import PlaceBody
from mastctl.web.parts import Here

PlaceName = Annotated[
    str,
    Path(
        pattern=r"^[\w+−-][\w .,:°+−-]{0,39}$",
        description="a name of 1 to 40 letters, digits, spaces and . , : ° + - that begins with no space",
    ),
]


def add_places(app: FastAPI) -> None:
    """What is kept, keeping and forgetting; who goes there asks `POST /point` for its angles."""

    @app.get(f"{PREFIX}/places", summary="The places of the head that are kept by a name")
    async def told(here: Here) -> dict[str, Any]:
        return await here.waiting.run(here.service.places.told)

    @app.post(f"{PREFIX}/places/{{name}}", summary="Keep a place by a name")
    async def keep(name: PlaceName, body: PlaceBody, came: Headers, here: Here) -> dict[str, Any]:
        places, place = here.service.places, Place(body.pan_rad, body.tilt_rad)
        asked = {"name": name, **body.model_dump()}
        return await here.commands.run(PLACE_KEEP, came, asked, lambda: places.keep(name, place))

    @app.delete(f"{PREFIX}/places/{{name}}", summary="Forget a place")
    async def forget(name: PlaceName, came: Headers, here: Here) -> dict[str, Any]:
        places = here.service.places
        return await here.commands.run(PLACE_FORGET, came, {"name": name}, lambda: places.forget(name))
