"""A picture of a page, with its words."""

from __future__ import annotations

import base64
from dataclasses import dataclass


@dataclass(frozen=True)
class Figure:
    """A picture with its words.

    ``source`` is what `data_url` returns. ``kind`` is ``photo``; ``lines``, which follow the page into the
    dark; or ``map``, whose colours mean numbers and stay.
    """

    source: str
    alt: str
    caption: str = ""
    kind: str = "photo"


def data_url(content: bytes, kind: str) -> str:
    """Return the bytes of a picture (``png`` or ``jpeg``) as an address that holds them."""
    return f"data:image/{kind};base64,{base64.b64encode(content).decode()}"
