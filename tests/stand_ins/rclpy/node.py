"""A node that keeps what it publishes and logs, and whose parameters a test has set."""

from collections.abc import Callable
from typing import Any, Generic, TypeVar

Message = TypeVar("Message")
Service = TypeVar("Service")

parameters: dict[str, Any] = {}  # as --ros-args -p gives them
context_is_valid = True  # until it is shut down


class Parameter:
    def __init__(self, value: Any) -> None:
        self.value = value


class Publisher(Generic[Message]):
    def __init__(self) -> None:
        self.sent: list[Message] = []

    def publish(self, msg: Message) -> None:
        if not context_is_valid:
            raise RuntimeError("Failed to publish: publisher's context is invalid")  # RCLError in rclpy
        self.sent.append(msg)


class Logger:
    def __init__(self) -> None:
        self.said: list[str] = []

    def info(self, message: str) -> bool:
        self.said.append(message)
        return True

    error = info


class Node:
    def __init__(self, node_name: str) -> None:
        self.name, self.logger = node_name, Logger()
        self.publishers: dict[str, Publisher[Any]] = {}
        self.subscriptions: dict[str, Callable[[Any], None]] = {}
        self.services: dict[str, Callable[[Any, Any], Any]] = {}
        self.timers: list[tuple[float, Callable[[], None]]] = []

    def declare_parameter(self, name: str, value: Any = None) -> Parameter:
        if value == []:
            raise ValueError("the type of an empty list is not known")  # as in rclpy
        return Parameter(parameters.get(name, value))

    def create_publisher(self, msg_type: type[Message], topic: str, qos_profile: int) -> Publisher[Message]:
        self.publishers[topic] = Publisher[msg_type]()
        return self.publishers[topic]

    def create_subscription(
        self, msg_type: type[Message], topic: str, callback: Callable[[Message], None], qos_profile: int
    ) -> None:
        self.subscriptions[topic] = callback

    def create_service(self, srv_type: type, srv_name: str, callback: Callable[[Any, Any], Any]) -> None:
        self.services[srv_name] = callback

    def create_timer(self, timer_period_sec: float, callback: Callable[[], None]) -> None:
        self.timers.append((timer_period_sec, callback))

    def get_logger(self) -> Logger:
        return self.logger

    def destroy_node(self) -> None: ...
