"""A stand-in of ROS 2's rclpy, as far as examples/ros2 uses it: no middleware, and a program's test is the spinner."""

from collections.abc import Callable

from rclpy.node import Node

on_spin: list[Callable[[Node], None]] = []  # what happens while a node spins


def init(*, args: list[str] | None = None) -> None: ...


def spin(node: Node) -> None:
    for happens in on_spin:
        happens(node)


def try_shutdown() -> None: ...
