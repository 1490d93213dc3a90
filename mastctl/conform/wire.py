"""What is asked of a daemon and what it answers, byte for byte, and all of it remembered."""

from __future__ import annotations

import json
import time
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from mastctl.client import ClientError
from mastctl.client.connection import PREFIX, DaemonHttp
from mastctl.conform.checks import PromiseBroken, SubjectLost, expect

TIMEOUT_S = 20.0
MOST_REMEMBERED_BYTES = 4096
STOP_TRIES, STOP_TIMEOUT_S = 3, 5.0


@dataclass(frozen=True)
class Answer:
    """One answer; ``began_s`` and ``ended_s`` are this machine's, around the whole request."""

    method: str
    path: str
    status: int
    headers: Mapping[str, str]
    data: bytes
    began_s: float
    ended_s: float

    @property
    def asked(self) -> str:
        """The request in words."""
        return f"{self.method} {self.path}"

    @property
    def media_type(self) -> str:
        """What the answer says it is, without parameters."""
        return self.headers.get("content-type", "").partition(";")[0].strip().lower()

    def json(self) -> Any:
        """Return the body as strict JSON. Raises PromiseBroken."""
        try:
            return json.loads(self.data, parse_constant=_no_number)
        except (ValueError, RecursionError) as error:
            raise PromiseBroken(f"{self.asked}: the answer ({self.status}) is not JSON: {error}") from None

    def document(self) -> dict[str, Any]:
        """Return the JSON object that a good answer holds. Raises PromiseBroken."""
        expect(200 <= self.status < 300, f"{self.asked}: {self.status} where a success is expected{self.why}")
        document = self.json()
        expect(isinstance(document, dict), f"{self.asked}: the answer is no JSON object")
        told: dict[str, Any] = document
        return told

    @property
    def why(self) -> str:
        """What a refusal says, to follow a sentence; empty where it says nothing."""
        code, message = self.refusal
        return f" ({code}: {message})" if code else ""

    @property
    def refusal(self) -> tuple[str, str]:
        """Code and message of a refusal; empty where there is none of the right form."""
        try:
            error = json.loads(self.data)["error"]
            return str(error["code"]), str(error["message"])
        except (ValueError, LookupError, TypeError, RecursionError):
            return "", ""


class Wire:
    """A connection to a daemon that remembers every answer.

    Raises
    ------
    SubjectLost
        From every question, when nobody answers there any more.
    ClientError
        ``timeout``, when an answer does not come.
    """

    def __init__(self, url: str) -> None:
        self.url = url
        self._http = DaemonHttp(url, TIMEOUT_S)
        self.answers: list[Answer] = []

    def send(self, method: str, path: str, **options: Any) -> Answer:
        """Ask for a path of the whole address; return the answer whatever it is."""
        began_s = time.monotonic()
        try:
            came = self._http.send(method, path, **options)
        except ClientError as error:
            if error.code == "no_daemon":
                raise SubjectLost(str(error)) from None
            raise
        answer = Answer(method, path, came.status_code, came.headers, came.content, began_s, time.monotonic())
        self.answers.append(
            answer if len(answer.data) <= MOST_REMEMBERED_BYTES or "json" in answer.media_type
            else Answer(method, path, answer.status, answer.headers, b"", began_s, answer.ended_s)
        )  # fmt: skip
        return answer

    def ask(self, method: str, path: str, **options: Any) -> Answer:
        """Ask for a path of the interface."""
        return self.send(method, PREFIX + path, **options)

    def stop(self) -> Answer:
        """Stop the mast."""
        return self.ask("POST", "/stop")

    def close(self) -> None:
        """Let go of the connection."""
        self._http.close()


def stopped_for_good(url: str) -> str:
    """Stop the mast over connections of their own, whatever became of the others.

    Returns why it may still move, one sentence; empty when the daemon has confirmed the stop.
    """
    reason = ""
    for _ in range(STOP_TRIES):
        http = DaemonHttp(url, STOP_TIMEOUT_S)
        try:
            http.json("POST", "/stop")
            return ""
        except ClientError as error:
            reason = str(error)
        finally:
            http.close()
        time.sleep(0.2)
    return f"the stop at the end was not confirmed, the head may still move: {reason}"


def _no_number(word: str) -> float:
    raise ValueError(f"{word} where a finite number is expected")
