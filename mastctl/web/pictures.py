"""Routes of pictures with their facts, and of the mast file that they are to be read by."""

from __future__ import annotations

from functools import partial
from typing import Annotated, Any

from fastapi import FastAPI, Query
from fastapi.responses import Response

from mastctl.commands.entry import MAST, MAST_BACK
from mastctl.frame_facts import headers_of
from mastctl.report.pictures import encoded
from mastctl.service.mast_in_use import MastInUse
from mastctl.service.masts import Masts
from mastctl.web import PREFIX
from mastctl.web.commands import Headers
from mastctl.web.models import MastBody, SnapshotQuery
from mastctl.web.parts import Here


def add_pictures(app: FastAPI) -> None:
    """Frames with their facts, and the mast file they are to be read by."""

    @app.get(
        f"{PREFIX}/snapshot/{{camera}}",
        summary="A picture; its facts are in X-Mastctl headers",
        response_class=Response,
        responses={200: {"content": {"image/png": {}, "image/jpeg": {}}}},
    )
    async def snapshot(camera: str, query: Annotated[SnapshotQuery, Query()], here: Here) -> Response:
        service, waiting = here.service, here.waiting
        service.check_camera(camera)
        frame_id = query.frame_id

        def picture() -> Response:
            if frame_id is None:
                frame = service.snapshot(camera, query.fresh)
            else:
                frame = service.kept_frame(camera, frame_id)
            data = waiting.encode(lambda: encoded(frame.image, query.format))
            return Response(data, media_type=f"image/{query.format}", headers=headers_of(frame))

        return await waiting.picture(camera, picture, kept=frame_id is not None)

    @app.get(f"{PREFIX}/mast", summary="The mast file in use, byte for byte", response_class=Response)
    async def mast(here: Here) -> Response:
        in_use = here.service.masts.in_use
        return Response(
            in_use.data,
            media_type="application/yaml",
            headers={"X-Mastctl-Mast-Digest": in_use.stored.digest},
        )

    @app.post(f"{PREFIX}/mast", summary="Use another mast file, or the former one, from now on")
    async def load_mast(body: MastBody, came: Headers, here: Here) -> dict[str, Any]:
        masts, name = here.service.masts, body.file
        work = masts.back if name is None else partial(masts.load, name)
        asked = body.model_dump(exclude_none=True)
        return await here.commands.run(MAST, came, asked, lambda: _told(masts, work()))

    @app.post(f"{PREFIX}/mast/back", summary="Go back to the former mast file")
    async def back(came: Headers, here: Here) -> dict[str, Any]:
        masts = here.service.masts
        return await here.commands.run(MAST_BACK, came, {}, lambda: _told(masts, masts.back()))


def _told(masts: Masts, mast: MastInUse) -> dict[str, Any]:
    former = masts.former
    return {"mast": mast.told(), "former_mast": None if former is None else former.told()}
