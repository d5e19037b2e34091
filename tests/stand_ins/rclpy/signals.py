"""Which signals rclpy handles itself: those end the context, with which publishers publish, at once."""

from enum import IntEnum


class SignalHandlerOptions(IntEnum):
    NO = 0
    ALL = 3
