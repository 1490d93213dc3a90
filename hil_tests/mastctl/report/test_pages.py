"""Pages made of templates: nothing from outside is markup, nothing is fetched, nothing is left out."""

from __future__ import annotations

import re
from html.parser import HTMLParser

import pytest
from jinja2 import UndefinedError

from mastctl.report import pages
from mastctl.report.pages import Table
from mastctl.report.pictures import Figure, data_url

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


def page() -> str:
    """A report whose every text comes from outside."""
    figure = Figure(data_url(b"png", "png"), EVIL, EVIL, "lines")
    table = Table(("", EVIL, "x px"), [[EVIL, EVIL, "1.5"]])
    return pages.page(
        "pointing.html", title=EVIL, badge=pages.Badge(EVIL, '"><script>'), facts=[(EVIL, EVIL)],
        residuals=table, aim=EVIL, notes=[EVIL], landed=True, scatter=figure, views=[(EVIL, [[figure]])],
        targets=table,
    )  # fmt: skip


def test_texts_from_outside_are_never_markup_and_nothing_is_fetched() -> None:
    made = page()
    elements = Elements(made)
    assert "script" not in elements.names and "<script" not in made
    assert made.count("&lt;script&gt;alert(&#39;x&#39;)") > 15
    assert all(address.startswith("data:") for address in elements.addresses)
    assert not re.search(r"@import|url\(|https?:", made)


def test_a_report_has_one_main_part_and_no_empty_heading() -> None:
    made = page()
    assert made.count("<main>") == made.count("</main>") == 1
    assert not re.search(r"<th[^>]*>\s*</th>", made)
    assert '<th scope="col" class="number">x px</th>' in made


def test_a_name_that_is_not_given_is_refused_rather_than_left_empty() -> None:
    with pytest.raises(UndefinedError, match="residuals"):
        pages.page("pointing.html", title="t", badge=pages.Badge("b"), facts=[])
