"""Pages made of templates: nothing from outside is markup, nothing is fetched, nothing is left out."""

from __future__ import annotations

import re
from html.parser import HTMLParser
from pathlib import Path

import pytest
from jinja2 import UndefinedError

from mastctl.report import pages
from mastctl.report.pages import Table
from mastctl.report.pictures import Figure, data_url

STUDY = Path(__file__).with_name("study.html")
EVIL = "<script>alert('x')</script> & \"quoted\""


class Elements(HTMLParser):
    """Names of the elements of a page, and what they name outside it; a wrong nesting is an error."""

    VOID = frozenset({"meta", "img"})

    def __init__(self, page: str) -> None:
        super().__init__()
        self.names: list[str] = []
        self.addresses: list[str] = []
        self._open: list[str] = []
        self.feed(page)
        self.close()
        assert not self._open

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.names.append(tag)
        self.addresses += [value or "" for name, value in attrs if name in ("src", "href")]
        if tag not in self.VOID:
            self._open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        assert self._open.pop() == tag


def study(**changed: object) -> str:
    """A page of the study of calibration with words that somebody else chose."""
    table = Table((EVIL, "number"), [[EVIL, "1.5"]])
    told: dict[str, object] = {
        "title": EVIL,
        "badge": pages.Badge(EVIL, '"><script>'),
        "facts": [(EVIL, EVIL)],
        "station": EVIL,
        "plots": [(EVIL, Figure(data_url(b"png", "png"), EVIL, EVIL, "lines"))],
        "failures": table,
        **dict.fromkeys(("table_iv", "table_v", "pointing", "handoff"), table),
    }
    return pages.page(STUDY, **(told | changed))


def test_words_from_outside_are_never_markup() -> None:
    page = study()
    assert "script" not in Elements(page).names
    assert "<script" not in page
    assert page.count("&lt;script&gt;alert(&#39;x&#39;)") > 15


def test_a_page_fetches_nothing() -> None:
    page = study()
    assert all(address.startswith("data:") for address in Elements(page).addresses)
    assert not re.search(r"@import|url\(|https?:", page)


def test_a_name_that_nobody_gave_is_refused_rather_than_left_empty() -> None:
    with pytest.raises(UndefinedError, match="station"):
        pages.page(STUDY, title="t", badge=pages.Badge("b"), facts=[], table_iv=Table((), ()))


def test_a_report_has_one_main_part_and_no_empty_heading() -> None:
    text = study(failures=Table(["", "x px"], [["navcam left", "0.1"]]))
    assert text.count("<main>") == text.count("</main>") == 1
    assert not re.search(r"<th[^>]*>\s*</th>", text)
    assert '<th scope="col" class="number">x px</th>' in text
