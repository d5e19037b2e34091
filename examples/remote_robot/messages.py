"""What passes between a robot and whoever drives it: one JSON object a line, in UTF-8, over TCP.

The robot speaks first, once a connection is made:

    {"protocol": 1, "period": 0.05, "silence": 5, "low": [-2.0], "high": [2.0],
     "state_names": ["angle [rad]", "rate [rad/s]"], "control_names": ["torque [N m]"]}

Then its driver asks, and the robot answers each question once, with its number and the time [s] of its own clock:

    {"do": "reset", "number": 0, "seed": 3}           {"number": 0, "time": 7.10, "observation": [3.1, 0.0]}
    {"do": "control", "number": 1, "control": [0.5]}  {"number": 1, "time": 7.15, "observation": [3.0, -0.2]}
    {"do": "stop", "number": 2}                       {"number": 2, "time": 7.16}

A control is held for one period; the answer has what the sensors read at its end. Numbers count up from the reset. What
cannot be is answered by {"number": 7, "time": ..., "error": "in words"}, and the motors stop. They also stop where no
control has come for `silence` periods after an answer, or the connection has ended.
"""

import json
import socket
import time

PROTOCOL = 1
LONGEST = 2**16  # bytes of a line
# A driver whose computer is off says nothing more: without these it would keep the robot's side for itself.
ALIVE = {"TCP_KEEPIDLE": 5, "TCP_KEEPINTVL": 2, "TCP_KEEPCNT": 5}  # s, s, times; as far as a system has them


class Connection:
    """Sends and receives messages over a connected socket."""

    def __init__(self, connected: socket.socket):
        connected.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)  # a control does not wait for more
        connected.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
        for name, value in ALIVE.items():
            if hasattr(socket, name):
                connected.setsockopt(socket.IPPROTO_TCP, getattr(socket, name), value)
        self._socket, self._rest = connected, b""

    def send(self, message: dict) -> None:
        """Raises OSError where the connection has ended, or the other side has read nothing for a second."""
        self._socket.settimeout(1.0)
        self._socket.sendall(json.dumps(message).encode() + b"\n")

    def receive(self, seconds: float | None = None) -> dict:
        """The next message. Raises TimeoutError after so many seconds, OSError at the end, ValueError for no JSON."""
        until = None if seconds is None else time.monotonic() + seconds
        while b"\n" not in self._rest:
            self._socket.settimeout(None if until is None else max(1e-3, until - time.monotonic()))
            data = self._socket.recv(LONGEST)
            if not data:
                raise ConnectionError("the other side closed the connection")
            self._rest += data
            if len(self._rest) > LONGEST:
                raise ValueError("a message is longer than 64 KiB")
        line, _, self._rest = self._rest.partition(b"\n")
        try:
            message = json.loads(line)
        except RecursionError as error:
            raise ValueError("a message is nested too deeply") from error
        if not isinstance(message, dict):
            raise ValueError(f"a message is a JSON object, not {message!r}")
        return message

    def close(self) -> None:
        self._socket.close()
