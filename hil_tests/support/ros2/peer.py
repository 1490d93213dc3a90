"""A program that knows ROS 2 only - no mastctl, no HTTP - and does what the lines on its stdin say.

A line is a JSON list, a verb and its arguments; its result is a JSON line on stdout. Messages are objects of
their fields; long arrays are told by their length. Run with the Python of `hil_tests.support.ros2.prefix`.

    ["listen", TOPIC, TYPE, QOS]           QOS: reliable, sensor, latched
    ["heard", TOPIC, COUNT, SECONDS]       the newest COUNT messages (0: all), each with its time of arrival
    ["fresh", TOPIC, SECONDS]              the next message
    ["publish", TOPIC, TYPE, FIELDS]       once somebody listens
    ["call", SERVICE, TYPE, FIELDS]
    ["goal", ACTION, TYPE, FIELDS, CANCEL_AFTER_S or null]
    ["leave", ACTION, TYPE, FIELDS]        sends a goal and ends, in order, without waiting for it
"""

from __future__ import annotations

import json
import os
import sys
import threading
import time
from importlib import import_module
from typing import Any

import rclpy
from rclpy.action import ActionClient
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, qos_profile_sensor_data

QOS = {
    "reliable": QoSProfile(depth=1000),
    "sensor": qos_profile_sensor_data,
    "latched": QoSProfile(depth=100, durability=DurabilityPolicy.TRANSIENT_LOCAL),
}
KEPT = 100_000
LONG = 100
NET_S = 60.0
LOOK_S = 0.005
MATCHED_S = 0.5
"""A subscriber that is known here already may not know this publisher yet, and nobody tells that."""


def type_of(name: str) -> Any:
    """Return the class of ``package/kind/Name``."""
    package, kind, word = name.split("/")
    return getattr(import_module(f"{package}.{kind}"), word)


def told(value: Any) -> Any:
    """Return a message, or a part of one, as JSON."""
    if hasattr(value, "get_fields_and_field_types"):
        return {name: told(getattr(value, name)) for name in value.get_fields_and_field_types()}
    if isinstance(value, (str, bool, int, float)):
        return value
    if isinstance(value, bytes):
        return int.from_bytes(value, "little")
    return f"{len(value)} numbers" if len(value) > LONG else [told(one) for one in value]


def filled(message: Any, fields: dict[str, Any]) -> Any:
    """Set fields of a message from JSON; a list of objects becomes one of messages."""
    for name, value in fields.items():
        if isinstance(value, dict):
            filled(getattr(message, name), value)
        elif isinstance(value, list) and value and isinstance(value[0], dict):
            kind = message.get_fields_and_field_types()[name].removeprefix("sequence<").removesuffix(">")
            package, word = kind.split("/")
            setattr(message, name, [filled(type_of(f"{package}/msg/{word}")(), one) for one in value])
        else:
            setattr(message, name, value)
    return message


class Peer:
    """A node that does one thing after another."""

    def __init__(self) -> None:
        self.node = Node("peer")
        self._heard: dict[str, list[tuple[float, Any]]] = {}
        self._publishers: dict[str, Any] = {}
        self._spinning = SingleThreadedExecutor()
        self._spinning.add_node(self.node)
        threading.Thread(target=self._spinning.spin, daemon=True).start()

    def listen(self, topic: str, kind: str, qos: str) -> None:
        """Keep what is published."""
        kept = self._heard[topic] = []

        def hear(message: Any) -> None:
            kept.append((time.time(), message))
            del kept[:-KEPT]

        self.node.create_subscription(type_of(kind), topic, hear, QOS[qos])

    def heard(self, topic: str, count: int, seconds: float) -> list[Any]:
        """Return the newest messages, once there are so many; 0: all that there are."""
        self._until(lambda: len(self._heard[topic]) >= count, seconds)
        return [[at_s, told(message)] for at_s, message in self._heard[topic][-count:]]

    def fresh(self, topic: str, seconds: float) -> list[Any]:
        """Return a message that comes after this moment."""
        before = len(self._heard[topic])
        self._until(lambda: len(self._heard[topic]) > before, seconds)
        return self.heard(topic, 1, seconds)

    def publish(self, topic: str, kind: str, fields: dict[str, Any]) -> None:
        """Publish a message."""
        if topic not in self._publishers:
            qos = QOS["latched" if topic == "/tf_static" else "reliable"]
            self._publishers[topic] = self.node.create_publisher(type_of(kind), topic, qos)
        publisher = self._publishers[topic]
        self._until(publisher.get_subscription_count, NET_S)
        time.sleep(MATCHED_S)
        publisher.publish(filled(type_of(kind)(), fields))

    def call(self, service: str, kind: str, fields: dict[str, Any]) -> Any:
        """Ask a service."""
        client = self.node.create_client(type_of(kind), service)
        if not client.wait_for_service(NET_S):
            raise TimeoutError(service)
        return told(self._done(client.call_async(filled(type_of(kind).Request(), fields))))

    def goal(self, action: str, kind: str, fields: dict[str, Any], cancel_after_s: float | None) -> Any:
        """Send a goal and wait for its end: status, result, how often there was feedback."""
        feedback: list[Any] = []
        client = ActionClient(self.node, type_of(kind), action)
        if not client.wait_for_server(NET_S):
            raise TimeoutError(action)
        goal = filled(type_of(kind).Goal(), fields)
        taken = self._done(client.send_goal_async(goal, feedback_callback=feedback.append))
        if cancel_after_s is not None:
            time.sleep(cancel_after_s)
            self._done(taken.cancel_goal_async())
        ended = self._done(taken.get_result_async())
        self._destroy(client)
        return {"status": ended.status, "result": told(ended.result), "feedback": len(feedback)}

    def leave(self, action: str, kind: str, fields: dict[str, Any]) -> None:
        """Send a goal, and end when it is taken."""
        client = ActionClient(self.node, type_of(kind), action)
        if not client.wait_for_server(NET_S):
            raise TimeoutError(action)
        self._done(client.send_goal_async(filled(type_of(kind).Goal(), fields)))
        time.sleep(3.0 * MATCHED_S)  # until the server has seen the client
        self._destroy(client)
        time.sleep(MATCHED_S)  # until the others have been told
        rclpy.shutdown()

    def _destroy(self, client: ActionClient) -> None:
        """Destroy a client in the thread that spins, which would end if another did."""
        self._done(self._spinning.create_task(client.destroy))

    def _done(self, future: Any) -> Any:
        self._until(future.done, NET_S)
        return future.result()

    def _until(self, holds: Any, seconds: float) -> None:
        until_s = time.monotonic() + seconds
        while not holds():
            if time.monotonic() > until_s:
                raise TimeoutError("it did not come")
            time.sleep(LOOK_S)


def main() -> None:
    """Do what the lines say until there are no more."""
    rclpy.init()
    peer = Peer()
    for line in sys.stdin:
        verb, *arguments = json.loads(line)
        try:
            answer = {"ok": getattr(peer, verb)(*arguments)}
        except Exception as error:
            answer = {"error": repr(error)}
        sys.stdout.write(json.dumps(answer) + "\n")
        sys.stdout.flush()
    os._exit(0)  # ROS still spins


if __name__ == "__main__":
    main()
