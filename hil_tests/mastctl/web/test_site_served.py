"""The documentation at ``/docs``: served with a policy of its own, or refused in a sentence."""

from __future__ import annotations

from pathlib import Path

import httpx
import pytest
from fastapi import FastAPI
from starlette.testclient import TestClient

from mastctl.http.guard import EntryRules, Guard
from mastctl.http.refusals import add_errors
from mastctl.http.waiting import Waiting
from mastctl.web import page

PAGE = "<html>Start</html>"


def client_of(monkeypatch: pytest.MonkeyPatch, folder: Path) -> TestClient:
    """A client of the routes below ``/docs`` alone, behind the guard."""
    monkeypatch.setattr(page, "site_folder", lambda: folder / "html")
    app = FastAPI(docs_url=None)
    add_errors(app)
    page.add_site(app)
    guard = Guard(app, EntryRules(), Waiting(), None)
    return TestClient(guard, base_url="http://127.0.0.1", follow_redirects=False)


@pytest.fixture
def client(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> TestClient:
    (tmp_path / "html" / "start").mkdir(parents=True)
    (tmp_path / "html" / "index.html").write_text(PAGE)
    (tmp_path / "html" / "start" / "install.html").write_text("<html>Install</html>")
    (tmp_path / "secret.txt").write_text("outside the site")
    return client_of(monkeypatch, tmp_path)


@pytest.mark.parametrize("path", ["/docs/", "/docs/start/install.html"])
def test_without_a_built_site_one_sentence_says_how_to_build_it(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, path: str
) -> None:
    answer = client_of(monkeypatch, tmp_path).get(path)
    error = answer.json()["error"]
    assert (answer.status_code, error["code"]) == (404, "no_docs")
    assert "tools/docs" in error["message"]


def test_a_built_site_is_served_below_docs(client: TestClient) -> None:
    assert client.get("/docs").headers["location"] == "docs/"
    assert client.get("/docs/").text == PAGE
    page = client.get("/docs/start/install.html")
    assert page.headers["content-type"].startswith("text/html")
    assert page.headers["cache-control"] == "no-cache"
    assert "frame-ancestors 'none'" in page.headers["content-security-policy"]
    assert client.get("/docs/start/install.html", headers={"Range": "bytes=x"}).text == page.text
    kept = client.get("/docs/start/install.html", headers={"If-None-Match": page.headers["etag"]})
    assert kept.status_code == 304
    absent = client.get("/docs/start/nothing.html")
    assert (absent.status_code, absent.json()["error"]["code"]) == (404, "not_found")


@pytest.mark.parametrize("path", ["/docs/../secret.txt", "/docs/%2e%2e/secret.txt", "/docs//etc/passwd"])
def test_no_file_outside_the_site_is_served(client: TestClient, path: str) -> None:
    answer = client.get(httpx.URL(f"http://127.0.0.1{path}"))
    assert answer.status_code == 404
