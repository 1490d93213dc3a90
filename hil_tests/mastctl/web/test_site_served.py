"""The documentation at ``/docs``: served with a policy of its own, or refused in words."""

from __future__ import annotations

import base64
import hashlib
from collections.abc import Iterator
from pathlib import Path

import httpx
import pytest
from fastapi import FastAPI
from starlette.testclient import TestClient

from mastctl.http.guard import EntryRules, Guard
from mastctl.http.refusals import add_errors
from mastctl.http.waiting import Waiting
from mastctl.web import page

THEME = 'document.body.dataset.theme = "auto";'
PAGE = f'<html><script>{THEME}</script><script src="_static/furo.js"></script></html>'


@pytest.fixture
def client(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Iterator[TestClient]:
    """A client of the routes below ``/docs`` alone, behind the guard; the folder of the site is empty."""
    monkeypatch.setattr(page, "site_folder", lambda: tmp_path / "html")
    app = FastAPI(docs_url=None)
    add_errors(app)
    page.add_site(app)
    with TestClient(
        Guard(app, EntryRules(), Waiting().turn, None), base_url="http://127.0.0.1", follow_redirects=False
    ) as made:
        yield made


def build(folder: Path) -> None:
    (folder / "html" / "start").mkdir(parents=True)
    (folder / "html" / "index.html").write_text(PAGE)
    (folder / "html" / "start" / "install.html").write_text("<html>Install</html>")
    (folder / "secret.txt").write_text("outside the site")


def test_without_a_built_site_one_sentence_says_how_to_build_it(client: TestClient) -> None:
    answer = client.get("/docs/")
    error = answer.json()["error"]
    assert (answer.status_code, error["code"]) == (404, "no_docs")
    assert "tools/docs" in error["message"]


def test_a_site_that_was_built_later_is_served_below_docs(client: TestClient, tmp_path: Path) -> None:
    assert client.get("/docs/").status_code == 404
    build(tmp_path)
    assert client.get("/docs").headers["location"] == "docs/"
    assert client.get("/docs/").text == PAGE
    page = client.get("/docs/start/install.html")
    assert (
        page.headers["content-type"].startswith("text/html") and page.headers["cache-control"] == "no-cache"
    )
    kept = client.get("/docs/start/install.html", headers={"If-None-Match": page.headers["etag"]})
    assert kept.status_code == 304
    absent = client.get("/docs/start/nothing.html")
    assert (absent.status_code, absent.json()["error"]["code"]) == (404, "not_found")


def test_of_scripts_inside_a_page_only_the_themes_may_run(client: TestClient, tmp_path: Path) -> None:
    build(tmp_path)
    policy = client.get("/docs/").headers["content-security-policy"]
    digest = base64.b64encode(hashlib.sha256(THEME.encode()).digest()).decode()
    assert f"script-src 'self' 'sha256-{digest}';" in policy
    assert "script-src 'self' 'unsafe-inline'" not in policy and "frame-ancestors 'none'" in policy


@pytest.mark.parametrize("path", ["/docs/../secret.txt", "/docs/%2e%2e/secret.txt", "/docs//etc/passwd"])
def test_no_file_outside_the_site_is_served(client: TestClient, tmp_path: Path, path: str) -> None:
    build(tmp_path)
    answer = client.get(httpx.URL(f"http://127.0.0.1{path}"))
    assert answer.status_code == 404
