"""Pages made of templates: nothing from outside is markup, nothing is fetched, nothing is left out."""

from __future__ import annotations

import re
import sys
from html.parser import HTMLParser
from pathlib import Path

import cv2
import numpy as np
import pytest
from jinja2 import UndefinedError

from mastctl.report import pages, plots
from mastctl.report.pictures import Figure, data_url, encoded, enlarged, photo
from mastctl.report.tables import Table, number, x_y
from tools.studies import calibration

STUDY = Path(calibration.__file__).with_suffix(".html")
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


def test_without_matplotlib_the_page_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    assert plots.installed()
    monkeypatch.setitem(sys.modules, "matplotlib.figure", None)
    assert not plots.installed()
    page = study(plots=None)
    assert "No plots: matplotlib is not installed" in page and "data:image" not in page


def test_columns_of_numbers_stand_to_the_right_and_words_to_the_left() -> None:
    table = Table(("word", "number", "either"), [["a", "+1.0 m", "-"], ["2", "", "x"]])
    assert table.numeric == [False, True, False]
    assert Table(("one", "two"), []).numeric == [True, True]
    assert table.turned() == Table(["word", "a", "2"], [["number", "+1.0 m", ""], ["either", "-", "x"]])
    page = study(table_iv=table)
    assert '<td>a</td><td class="number">+1.0 m</td><td>-</td>' in page


def test_numbers_that_there_are_not_leave_their_cell_empty() -> None:
    assert (number(None), number(float("nan")), number(1.005, 1)) == ("", "", "1.0")
    assert (x_y(None), x_y((1.0, -2.0)), x_y((1.0, -2.0), 3)) == ("", "1.00, -2.00", "1.000, -2.000")


def test_an_enlarged_piece_has_its_pixel_in_the_middle_and_is_black_beyond_the_edge() -> None:
    image = np.full((20, 30), 100, np.uint8)
    image[2, 3] = 250
    piece = enlarged(image, (3.0, 2.0), 5, 4)
    assert piece.shape == (41, 41, 3)
    assert tuple(piece[20, 20]) == (250, 250, 250)
    assert tuple(piece[0, 0]) == (0, 0, 0) and tuple(piece[40, 40]) == (100, 100, 100)


def test_pictures_come_back_from_their_bytes() -> None:
    image = np.random.default_rng(1).integers(0, 255, (8, 9), dtype=np.uint8)
    back = cv2.imdecode(np.frombuffer(encoded(image, "png"), np.uint8), cv2.IMREAD_UNCHANGED)
    assert (back == image).all()
    assert photo(image, "a", "b").source.startswith("data:image/jpeg;base64,/9j/")


def test_colours_of_plots_are_those_of_pictures() -> None:
    assert plots.bgr("#0102ff") == (255, 2, 1)
