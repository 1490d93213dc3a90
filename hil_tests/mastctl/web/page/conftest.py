"""A real browser for the operator page: Debian's chromium, driven by Playwright."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any
from urllib.parse import urlsplit

import pytest

from hil_tests.waiting import NET_S
from mastctl.web import pictures
from mastctl.web.page import PAGE_FOLDER
from tools.browser import chromium

if TYPE_CHECKING:  # slow to load, and every worker loads this file
    from playwright.sync_api import Browser, BrowserContext, Page

BOUND_MS = 1e3 * NET_S
STALE = "const STALE_S = 1.0;"
OLD_MS = int(1e3 * (NET_S + 1.0))
"""So far the page's clock is turned to make an image old, or a stream silent."""


@pytest.fixture(autouse=True)
def _few_pictures(monkeypatch: pytest.MonkeyPatch) -> None:
    """Drawing the usual 22 a second of each camera takes most of a browser's processor time."""
    monkeypatch.setattr(pictures, "APART_S", 0.25)


@pytest.fixture(scope="module")
def browser(request: pytest.FixtureRequest) -> Iterator[Browser]:
    """One for a file: where Playwright runs no other test may run an event loop of its own."""
    from playwright.sync_api import sync_playwright

    found = chromium()
    if found is None:
        words = "the page's tests need chromium: python -m tools.browser installs it on Debian"
        (pytest.fail if request.config.getoption("--require-vm") else pytest.skip)(words)
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(
            executable_path=found, args=["--no-sandbox", "--process-per-site"]
        )
        yield browser
        browser.close()


@dataclass
class Visit:
    """A page that was opened, and what it asked and complained of."""

    page: Page
    url: str
    asked: list[tuple[str, str]] = field(default_factory=list)
    complaints: list[str] = field(default_factory=list)

    def posts(self, path: str) -> list[str]:
        """Bodies of what was posted to a path of the API."""
        self.told()
        return [body for where, body in self.asked if where == f"POST /api/v1{path}"]

    def told(self) -> list[str]:
        """What was asked for so far."""
        self.page.title()  # whatever the browser told meanwhile is heard by that
        return [where for where, _ in self.asked]

    def frame(self, camera: str = "navcam_left") -> Any:
        """The image of a camera, once it is fresh and of a head at rest."""
        self.page.wait_for_selector(f".eye[data-camera={camera}]:not([data-stale], [data-moving])")
        return self.page.locator(f".eye[data-camera={camera}] .frame")

    def choose(
        self, camera: str = "navcam_left", part: tuple[float, float] = (0.5, 0.5), press: str = "click"
    ) -> str:
        """Choose a pixel; what is told."""
        frame = self.frame(camera)
        box = frame.bounding_box()
        getattr(frame, press)(position={"x": part[0] * box["width"], "y": part[1] * box["height"]})
        return self.target("preview", "refused")

    def wait_long(self) -> None:
        """Turn the page's clock on by more than any image may be old; it was opened with ``turned=True``."""
        self.page.clock.fast_forward(OLD_MS)

    def target(self, *states: str) -> str:
        """The words of the panel of the target, once it is in a state."""
        self.page.wait_for_selector(", ".join(f"#target[data-state={state}]" for state in states))
        return self.page.locator("#target").inner_text()

    def serious(self, context: str | None = None) -> list[Any]:
        """What axe finds that shuts somebody out, in a part of the page or all of it."""
        from axe_playwright_python.sync_playwright import Axe  # type: ignore[import-untyped]

        return [
            (each["id"], each["nodes"][0]["html"][:160], each["nodes"][0].get("failureSummary"))
            for each in Axe().run(self.page, context=context).response["violations"]
            if each["impact"] in ("serious", "critical")
        ]

    def word(self, word: str) -> None:
        """Wait until the state is told in a word."""
        self.page.wait_for_selector(f"#state[data-word={word}]")


@pytest.fixture
def visit(browser: Browser) -> Iterator[Callable[..., Visit]]:
    """Opens the page; in the end nothing may have gone off the host, and the console must be silent.

    On a busy machine images come late. So they count as old after the net of 60 s, not after 1 s, and a test
    of what is old turns the page's clock (``turned=True``).
    """
    contexts: list[BrowserContext] = []
    made: list[Visit] = []

    source = (PAGE_FOLDER / "eye.js").read_text()
    assert STALE in source
    patient = source.replace(STALE, f"const STALE_S = {NET_S};")

    def opened(url: str, turned: bool = False, **options: Any) -> Visit:
        context = browser.new_context(**{"viewport": {"width": 1400, "height": 950}, **options})
        contexts.append(context)
        context.set_default_timeout(BOUND_MS)
        context.route("**/eye.js", lambda to: to.fulfill(content_type="text/javascript", body=patient))
        page = context.new_page()
        if turned:
            page.clock.install()
        one = Visit(page, url)
        made.append(one)
        page.on("console", lambda said: one.complaints.extend([said.text] if said.type == "error" else []))
        page.on("pageerror", lambda error: one.complaints.append(str(error)))
        page.on("request", lambda sent: one.asked.append((_named(sent), sent.post_data or "")))
        page.on("websocket", lambda line: one.asked.append((f"WS {line.url}", "")))
        page.goto(url)
        return one

    yield opened
    complaints = [words for one in made for words in one.complaints if not _answered(words)]
    foreign = [where for one in made for where, _ in one.asked if not _own(where, one.url)]
    for context in contexts:
        context.close()
    assert not complaints, complaints
    assert not foreign, foreign


def _named(sent: Any) -> str:
    parts = urlsplit(sent.url)
    own = urlsplit(sent.frame.url).netloc if sent.frame.url != "about:blank" else parts.netloc
    return f"{sent.method} {parts.path if parts.netloc == own else sent.url}"


def _own(where: str, url: str) -> bool:
    _, _, address = where.partition(" ")
    return address.startswith("/") or urlsplit(address).netloc in ("", urlsplit(url).netloc)


def _answered(words: str) -> bool:
    """The browser's own line about an answer that is a refusal, or a daemon that a test has ended."""
    return bool(re.search(r"Failed to load resource|WebSocket connection to .* failed|ERR_CONNECTION", words))
