"""The pages of docs/ at ``/docs``: the site that `tools/docs` built, from the wheel or from the checkout."""

from __future__ import annotations

import base64
import hashlib
import re
from functools import cache
from pathlib import Path
from typing import Any

from fastapi import FastAPI
from starlette.exceptions import HTTPException
from starlette.responses import RedirectResponse, Response
from starlette.staticfiles import StaticFiles
from starlette.types import Scope

from mastctl.errors import NotKnown
from mastctl.packaged import site_folder
from mastctl.web.page import ASK_AGAIN

_SCRIPT = re.compile(r"<script>(.*?)</script>", re.DOTALL)


def add_site(app: FastAPI) -> None:
    """The site below ``/docs/``; where it was not built, a refusal that says how to build it."""

    @app.get("/docs", include_in_schema=False)
    async def docs() -> Response:
        return RedirectResponse("docs/")  # relative: a proxy may serve the daemon below a path of its own

    app.mount("/docs/", _Site(site_folder()))


class _Site(StaticFiles):
    """Files of a folder that may appear later."""

    def __init__(self, folder: Path) -> None:
        super().__init__(directory=folder, html=True, check_dir=False)
        self._first = folder / "index.html"
        self.config_checked = True  # a folder that is absent is refused in words below

    async def get_response(self, path: str, scope: Scope) -> Response:
        try:
            return await super().get_response(path, scope)
        except HTTPException as refused:
            if refused.status_code == 404 and not self._first.is_file():
                words = (
                    "the documentation is not part of this installation; `tools/docs` in a checkout builds it"
                )
                raise NotKnown("no_docs", words) from None
            raise

    def file_response(self, *args: Any, **options: Any) -> Response:
        answer = super().file_response(*args, **options)
        answer.headers["Cache-Control"] = ASK_AGAIN
        if answer.headers.get("Content-Type", "").startswith("text/html"):
            answer.headers["Content-Security-Policy"] = _policy(self._first)
        return answer


@cache
def _policy(first: Path) -> str:
    """The Content-Security-Policy of the site: of scripts inside a page only the theme's, by its digest."""
    inside = set(_SCRIPT.findall(first.read_text(encoding="utf-8")))
    digests = (base64.b64encode(hashlib.sha256(one.encode()).digest()).decode() for one in sorted(inside))
    scripts = " ".join(["'self'", *(f"'sha256-{one}'" for one in digests)])
    return (
        f"default-src 'self'; script-src {scripts}; style-src 'self' 'unsafe-inline'; img-src 'self' data:; "
        "object-src 'none'; base-uri 'none'; form-action 'self'; frame-ancestors 'none'"
    )
