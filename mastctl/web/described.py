"""How /openapi.json describes the answers: a model for each route, without a cost when an answer is given."""

from __future__ import annotations

import threading
from collections.abc import Mapping
from functools import cache
from typing import Any

from fastapi import FastAPI
from fastapi.responses import JSONResponse
from pydantic import BaseModel
from pydantic.json_schema import models_json_schema

from mastctl.frame_facts import described_headers
from mastctl.web import PREFIX
from mastctl.web import answers as told
from mastctl.web import bench_answers as bench
from mastctl.web.event_answers import Event

ANSWERS: Mapping[str, type[BaseModel]] = {
    "GET /calibration/health": told.CalibrationHealthTold,
    "GET /sentinel": told.SentinelTold,
    "GET /status": told.Status,
    "POST /point": told.Started,
    "POST /point/preview": told.PreviewTold,
    "GET /operations": told.Operations,
    "GET /operations/{operation_id}": told.OperationTold,
    "POST /stop": told.StopTold,
    "POST /estop": told.EstopTold,
    "POST /reset": told.ResetTold,
    "POST /pose": told.PoseTaken,
    "GET /track": told.TrackTold,
    "POST /track": told.Started,
    "POST /track/look": told.Started,
    "POST /track/stop": told.TrackTold,
    "POST /jog": told.JogTold,
    "GET /history": told.HistoryTold,
    "GET /recordings": told.Recordings,
    "POST /recordings/start": told.RecorderTold,
    "POST /recordings/stop": told.RecordingEnded,
    "DELETE /recordings/{name}": told.RecordingDeleted,
    "GET /limits/sun": told.SunTold,
    "POST /limits/sun": told.SunTold,
    "DELETE /limits/sun": told.SunTold,
    "GET /lease": told.LeaseTold,
    "POST /lease": told.LeaseGranted,
    "POST /lease/renew": told.LeaseGranted,
    "POST /lease/take": told.LeaseGranted,
    "DELETE /lease": told.LeaseTold,
    "GET /places": told.PlacesTold,
    "POST /places/{name}": told.PlacesTold,
    "DELETE /places/{name}": told.PlacesTold,
    "POST /reload": told.ReloadTold,
    "POST /mast": told.MastsTold,
    "POST /mast/back": told.MastsTold,
    "GET /simulation/pose": told.StandTold,
    "POST /simulation/pose": told.StandTold,
    "GET /simulation/boards": told.BoardsTold,
    "POST /simulation/boards/{name}": told.BoardStands,
    "DELETE /simulation/boards/{name}": told.BoardsTold,
    "GET /simulation/time": told.TimeTold,
    "POST /simulation/time": told.TimeTold,
    "GET /simulation/faults": told.FaultsSet,
    "POST /simulation/faults": told.FaultsSet,
    "DELETE /simulation/faults": told.FaultsSet,
    "GET /simulation/words": told.WordsTold,
    "GET /simulation/truth": told.TruthTold,
    "GET /health/live": told.LiveTold,
    "GET /health/ready": told.ReadyTold,
    "GET /rig": told.RigTold,
    "GET /bench": bench.BenchTold,
    "POST /bench": bench.BenchBegun,
    "POST /bench/stands": bench.BenchBegun,
    "POST /bench/leave": bench.BenchBegun,
    "DELETE /bench/runs/{name}": bench.BenchTold,
    "GET /reports": bench.ReportsTold,
    "GET /session": told.SessionTold,
    "POST /login": told.SessionTold,
    "POST /logout": told.LoggedOut,
}
EVENTS: Mapping[str, type[BaseModel]] = {"GET /events": Event, "GET /track/stream": told.TrackTold}
"""Server-sent events without an end: one line each, ``data:`` and the model's JSON."""
FILES: Mapping[str, tuple[str, ...]] = {
    "GET /snapshot/{camera}": ("image/png", "image/jpeg"),
    "GET /mast": ("application/yaml",),
    "GET /metrics": ("text/plain",),
    "GET /reports/{name}": ("text/html",),
    "GET /recordings/{name}/{file}": ("application/octet-stream",),
}
PICTURES = ("GET /snapshot/{camera}",)
_ONE_MAKES_IT = threading.Lock()
_REFERENCE = "#/components/schemas/{model}"


def description(app: FastAPI) -> bytes:
    """Return what /openapi.json tells of an app that has all its routes."""
    with _ONE_MAKES_IT:
        return _made(app)


def is_made() -> bool:
    """Return whether `description` only hands out what it has made before."""
    return _made.cache_info().currsize > 0


@cache
def _made(app: FastAPI) -> bytes:
    document = app.openapi()
    _describe(document)
    return bytes(JSONResponse(document).body)


def answer_schemas() -> dict[str, Any]:
    """Return the JSON schema of each model of an answer, by its name."""
    models = {*ANSWERS.values(), *EVENTS.values()}
    pairs = sorted(((one, "serialization") for one in models), key=lambda pair: pair[0].__name__)
    _, schemas = models_json_schema(pairs, ref_template=_REFERENCE)  # type: ignore[arg-type]
    return dict(schemas["$defs"])


def _describe(document: dict[str, Any]) -> None:
    """Put the models, events and files where they are answered."""
    document["components"]["schemas"].update(answer_schemas())
    _without_null(document)
    for route, success in _successes(document).items():
        if route in ANSWERS:
            model = ANSWERS[route]
            success["description"] = (model.__doc__ or model.__name__).strip().splitlines()[0]
            success["content"] = {"application/json": {"schema": _reference(model)}}
        elif route in EVENTS:
            stream = {"schema": {"type": "string"}, "x-endless": True, "x-event": _reference(EVENTS[route])}
            success["content"] = {"text/event-stream": stream}
        elif route in FILES:
            success["content"] = {kind: {"schema": _form(kind)} for kind in FILES[route]}
            if route in PICTURES:
                success["headers"] = described_headers()


def _form(kind: str) -> dict[str, str]:
    """What a file of a kind holds."""
    return {"type": "object"} if kind == "application/yaml" else {"type": "string", "format": "binary"}


def _without_null(document: Mapping[str, Any]) -> None:
    """Say of headers and queries that they are there or not: null is no word of an address."""
    for methods in document["paths"].values():
        for operation in methods.values():
            for parameter in operation.get("parameters", ()):
                schema = parameter["schema"]
                kinds = [one for one in schema.get("anyOf", ()) if one.get("type") != "null"]
                if len(kinds) == 1:
                    del schema["anyOf"]
                    schema.update(kinds[0])


def _successes(document: Mapping[str, Any]) -> dict[str, dict[str, Any]]:
    """The good answer of each route."""
    return {
        f"{method.upper()} {path.removeprefix(PREFIX)}": told
        for path, methods in document["paths"].items()
        for method, operation in methods.items()
        for status, told in operation["responses"].items()
        if status.startswith("2")
    }


def _reference(model: type[BaseModel]) -> dict[str, str]:
    return {"$ref": _REFERENCE.format(model=model.__name__)}
