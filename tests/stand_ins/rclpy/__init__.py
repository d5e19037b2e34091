"""A stand-in of ROS 2's rclpy, as far as examples/ros2 uses it: no middleware, and a program's test is the spinner."""

from collections.abc import Callable

from rclpy import node
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions

on_spin: list[Callable[[Node], None]] = []  # what happens while a node spins


handled = SignalHandlerOptions.ALL


def init(
    *, args: list[str] | None = None, signal_handler_options: SignalHandlerOptions = SignalHandlerOptions.ALL
) -> None:
    global handled
    handled, node.context_is_valid = signal_handler_options, True


def spin(spun: Node) -> None:
    try:
        for happens in on_spin:
            happens(spun)
    except KeyboardInterrupt:
        node.context_is_valid = handled == SignalHandlerOptions.NO  # as since ROS 2 Humble
        raise


def try_shutdown() -> None: ...
