"""``GET /metrics``: what a daemon is and has done, in Prometheus' text format.

The present state is read from the status at each request; events are counted as they are
published, in a thread of its own, so that nothing that happens waits for being counted.
"""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable, Iterable, Mapping
from typing import Any, get_args

from prometheus_client import CollectorRegistry, Counter, Histogram, generate_latest
from prometheus_client.core import (
    CounterMetricFamily,
    GaugeMetricFamily,
    InfoMetricFamily,
    Metric,
    StateSetMetricFamily,
)
from prometheus_client.process_collector import ProcessCollector

from mastctl.answers import ServiceState, Status
from mastctl.control.operations import Operation
from mastctl.control.publisher import Published, Publisher

log = logging.getLogger(__name__)

CONTENT_TYPE = "text/plain; version=0.0.4; charset=utf-8"

RESIDUAL_PX = (0.02, 0.05, 0.1, 0.2, 0.5, 1.0, 2.0, 5.0, 10.0)
SIGMAS = (0.5, 1.0, 1.5, 2.0, 3.0, 5.0, 10.0)
STEP_S = (0.005, 0.02, 0.05, 0.1, 0.2, 0.5, 1.0, 2.0, 5.0, 10.0, 30.0)
READING_S = (0.005, 0.01, 0.02, 0.03, 0.05, 0.075, 0.1, 0.2, 0.5, 1.0)
ENDED = frozenset({"done", "failed", "stopped"})


class Metrics:
    """The figures of one daemon, in a registry of their own.

    ``errors``: how often calls to devices have failed, by device, call, and the error's code;
    ``frame_counts``: how many frames were received and missed, by camera.
    """

    def __init__(
        self,
        status: Callable[[], Status],
        errors: Callable[[], Mapping[tuple[str, str, str], int]],
        frame_counts: Callable[[], Mapping[str, tuple[int, int]]],
        publisher: Publisher,
        temperatures_c: Callable[[], Mapping[str, float]] = dict,
    ) -> None:
        self._status, self._errors, self._frame_counts = status, errors, frame_counts
        self._temperatures_c = temperatures_c
        self._registry = CollectorRegistry()
        self._registry.register(self)
        ProcessCollector(registry=self._registry)
        self._operations = self._counter("operations", "Operations that have ended.", "state", "code")
        self._commands = self._counter("commands", "Commands, by what came of them.", "command", "result")
        self._frames = self._counter("frames", "Frames taken on request.", "camera")
        self._residual = self._histogram("residual_pixels", "Residuals, each axis by itself.", RESIDUAL_PX)
        self._sigmas = self._histogram("residual_sigmas", "Residuals over their sigma.", SIGMAS)
        self._step = self._histogram("step_seconds", "Steps of pointings and looks.", STEP_S, "step")
        self._reading = self._histogram(
            "reading_interval_seconds", "From one reading of the head to the next.", READING_S
        )
        self._last_reading_s: float | None = None
        self._news = publisher.subscribe("operation", "command", "frame", "joints")
        self._thread = threading.Thread(target=self._count, name="metrics", daemon=True)
        self._thread.start()

    def text(self) -> bytes:
        """Return everything in the text format."""
        return bytes(generate_latest(self._registry))

    def close(self) -> None:
        """Count no more."""
        self._news.close()

    def _counter(self, name: str, summary: str, *labels: str) -> Counter:
        return Counter(name, summary, labels, namespace="mastctl", registry=self._registry)

    def _histogram(self, name: str, summary: str, bounds: tuple[float, ...], *labels: str) -> Histogram:
        return Histogram(name, summary, labels, namespace="mastctl", buckets=bounds, registry=self._registry)

    # In the listener's thread

    def _count(self) -> None:
        lost = 0
        while not self._news.closed:
            news = self._news.wait()
            if self._news.lost > lost:  # the next reading follows none
                lost = self._news.lost
                self._last_reading_s = None
            for one in news:
                try:
                    self._counted(one)
                except Exception:  # an unexpected record must not end the counting
                    log.exception("a message published under %s could not be counted", one.topic)

    def _counted(self, one: Published) -> None:
        if one.topic == "operation":
            if one.value.state in ENDED:
                self._operation(one.value)
        elif one.topic == "command":
            if "result" in one.value:  # not the record of its operation's end
                self._commands.labels(one.value["command"], one.value["result"]).inc()
        elif one.topic == "frame":
            self._frames.labels(one.key).inc()
        elif one.topic == "joints":
            before, self._last_reading_s = self._last_reading_s, one.value.time_s
            if before is not None:
                self._reading.observe(one.value.time_s - before)

    def _operation(self, operation: Operation) -> None:
        record = operation.as_json()
        error = record["error"]
        self._operations.labels(operation.state, "" if error is None else error["code"]).inc()
        for step in record["steps"]:
            if step.get("duration_s") is not None:
                self._step.labels(str(step["name"])).observe(step["duration_s"])
        for pointing in record["pointings"]:
            residual = pointing.get("residual_px") or ()
            for off, sigma in zip(residual, pointing.get("residual_sigma_px") or (), strict=False):
                if off is not None and sigma:
                    self._residual.observe(abs(off))
                    self._sigmas.observe(abs(off) / sigma)

    # For the library

    def describe(self) -> Iterable[Metric]:
        """Return nothing: without it the library would read a status to find the names."""
        return ()

    def collect(self) -> Iterable[Metric]:
        """Yield the present state."""
        status = self._status()
        mast, joints, control = status["mast"], status["joints"], status["control"]
        about = {"version": status["version"], "hardware": status["hardware"]}
        about |= {"mast_file": mast["file"], "mast_digest": mast["digest"]}
        yield InfoMetricFamily("mastctl", "The program and what it drives.", about)
        states = StateSetMetricFamily("mastctl_state", "The state of the daemon.")
        states.add_metric([], {state: state == status["state"] for state in get_args(ServiceState)})
        yield states
        yield _gauge("uptime_seconds", "Since the daemon started.", {(): status["uptime_s"]})
        if joints is not None:
            angles = {("pan",): joints["pan_rad"], ("tilt",): joints["tilt_rad"]}
            yield _gauge("joint_radians", "Measured joint angle.", angles, "axis")
            yield _gauge("joints_age_seconds", "Since the head was read.", {(): joints["age_s"]})
        warm = {(name,): value for name, value in self._temperatures_c().items()}
        yield _gauge("axis_temperature_celsius", "As the axis reports.", warm, "axis")
        ages = {(name,): camera["age_s"] for name, camera in status["cameras"].items()}
        yield _gauge("frame_age_seconds", "Of the newest frame.", ages, "camera")
        faults = {(fault["device"], fault["code"]): 1.0 for fault in status["faults"]}
        yield _gauge("fault", "1 for each fault.", faults, "device", "code")
        failed = "Calls to devices that failed."
        yield _count("device_errors", failed, self._errors(), "device", "call", "code")
        counts = self._frame_counts()
        received = {(name,): good for name, (good, _) in counts.items()}
        yield _count("frames_received", "Frames that a camera sent, requested or not.", received, "camera")
        missed = {(name,): lost for name, (_, lost) in counts.items()}
        yield _count("frames_missed", "Frames of a camera that were lost or damaged.", missed, "camera")
        # The holder of a lease is no label, since clients choose their names.
        steers = {} if control is None else {(control["kind"],): 1.0}
        yield _gauge("lease", "1 for what steers: lease, operation.", steers, "kind")
        left_s = None if control is None else control["for_s"]
        yield _gauge("lease_left_seconds", "Until the lease is over.", {(): left_s})
        calibration, sentinel = status["calibration"], status["sentinel"]
        drifts = {(): float(calibration["verdict"] == "drifts")}
        yield _gauge("calibration_drifts", "1 if the mast file is not valid any more.", drifts)
        judged = {(): float(calibration["pointings"])}
        yield _gauge("calibration_pointings", "Of the last days, that are judged.", judged)
        yield _gauge("sentinel_look_age_seconds", "Since the last look.", {(): sentinel["age_s"]})


def _gauge(name: str, summary: str, values: Mapping[Any, float | None], *labels: str) -> Metric:
    """A gauge with its values by labels; what is not known is left out."""
    return _filled(GaugeMetricFamily(f"mastctl_{name}", summary, labels=labels), values)


def _count(name: str, summary: str, values: Mapping[Any, int], *labels: str) -> Metric:
    """A counter with its values by labels."""
    return _filled(CounterMetricFamily(f"mastctl_{name}", summary, labels=labels), values)


def _filled(family: GaugeMetricFamily | CounterMetricFamily, values: Mapping[Any, float | None]) -> Metric:
    for each, value in values.items():
        if value is not None:
            family.add_metric(each, value)
    return family
