"""The robot's side of a connection: it holds controls, reads sensors, and stops the motors when nobody drives it.

    python robot_side.py port=5555

It runs where the robot is, and needs Python and `messages.py`, not pegasus_jax. `Arm` is a simulation: put your drivers
in place of its three methods. Words: host=127.0.0.1 port=5555 period=0.05 silence=5. Whoever reaches the port can drive
the robot: listen on a network of your own only, or on 127.0.0.1 through ssh -L 5555:127.0.0.1:5555.
"""

import math
import random
import signal
import socket
import sys
import time

from messages import PROTOCOL, Connection


class Arm:
    """A motor too weak to lift the arm at once swings it up; it moves as time goes by."""

    state_names, control_names = ["angle [rad]", "rate [rad/s]"], ["torque [N m]"]
    low, high = [-2.0], [2.0]

    def start(self, seed: int | None) -> None:
        """Bring the robot to where an episode starts. Yours: this may take as long as it has to."""
        draw = random.Random(seed)
        self.angle, self.rate, self.torque = math.pi + draw.gauss(0, 0.05), draw.gauss(0, 0.05), 0.0
        self.now = time.monotonic()

    def motors(self, control: list[float]) -> None:
        """Send a control; zeros stop the motors."""
        (self.torque,) = control

    def read(self) -> list[float]:
        """The sensors, in the order of state_names."""
        passed, step = time.monotonic() - self.now, 0.001
        for _ in range(min(round(passed / step), 1000)):
            self.rate += step * (3.0 * math.sin(self.angle) + self.torque - 0.02 * self.rate) / 0.2
            self.angle += step * self.rate
        self.now += passed
        return [self.angle + random.gauss(0, 0.01), self.rate + random.gauss(0, 0.01)]


class Side:
    """Answers one driver at a time."""

    def __init__(self, robot: Arm, period: float, silence: int):
        self.robot, self.period, self.silence = robot, period, silence
        self.moving, self.last, self.due = False, None, 0.0

    def hello(self) -> dict:
        robot = self.robot
        limits = {"low": robot.low, "high": robot.high, "period": self.period, "silence": self.silence}
        names = {"state_names": robot.state_names, "control_names": robot.control_names}
        return {"protocol": PROTOCOL, **limits, **names}

    def serve(self, driver: Connection) -> None:
        """Answer a driver until the connection ends; then, and where it is silent, the motors stop."""
        try:
            driver.send(self.hello())
            while True:
                try:
                    asked = driver.receive(self.silence * self.period if self.moving else None)
                except TimeoutError:
                    self.stop(f"no control for {self.silence} periods")
                    continue
                driver.send(self.answer(asked))
        except (OSError, ValueError) as error:
            self.stop(f"{type(error).__name__}: {error}")
        finally:
            self.last = None
            self.stop("this side ends")
            driver.close()

    def answer(self, asked: dict) -> dict:
        """What to answer to a question; a fault of either side is an answer too, and stops the motors."""
        answer = {"number": asked.get("number")}
        try:
            do = {"reset": self.reset, "control": self.control, "stop": self.ended}[asked["do"]]
            answer |= do(asked)
        except (KeyError, TypeError, ValueError, ArithmeticError) as error:
            self.last = None
            self.stop("a question that cannot be answered")
            answer["error"] = f"{type(error).__name__}: {error}"
        return answer | {"time": time.monotonic()}

    def reset(self, asked: dict) -> dict:
        self.stop("reset")
        self.robot.start(asked.get("seed"))
        self.last, self.due = asked["number"], 0.0
        return {"observation": self.robot.read()}

    def control(self, asked: dict) -> dict:
        control = [float(value) for value in asked["control"]]
        if self.last is None:
            raise ValueError("the motors were stopped; a reset comes first")
        if asked["number"] != self.last + 1:
            raise ValueError(f"control {asked['number']} came after {self.last}")
        inside = [
            low <= value <= high for low, value, high in zip(self.robot.low, control, self.robot.high, strict=True)
        ]
        if not all(inside):  # a number that is none is not inside either
            raise ValueError(f"control {control} is not from {self.robot.low} to {self.robot.high}")
        self.robot.motors(control)
        now, self.last, self.moving = time.monotonic(), asked["number"], True
        # One period after the last one was due; after a late control the clock begins again.
        self.due = self.due + self.period if now - self.due < 0.5 * self.period else now + self.period
        time.sleep(max(0.0, self.due - now))
        return {"observation": self.robot.read()}

    def ended(self, asked: dict) -> dict:
        self.last = None
        self.stop("asked to")
        return {}

    def stop(self, why: str) -> None:
        """Stop the motors if they are on. After a silence, controls are refused until the next reset."""
        if self.moving:
            self.robot.motors([0.0] * len(self.robot.low))
            self.moving, self.last = False, None
            print(f"motors stopped: {why}", flush=True)


def main(*words: str) -> None:
    given = {"host": "127.0.0.1", "port": "5555", "period": "0.05", "silence": "5"}
    given |= dict(word.split("=", 1) for word in words)
    side = Side(Arm(), float(given["period"]), int(given["silence"]))
    for name in ("SIGTERM", "SIGHUP"):  # Windows has no SIGHUP; nohup leaves it ignored
        if hasattr(signal, name) and signal.getsignal(getattr(signal, name)) != signal.SIG_IGN:
            signal.signal(getattr(signal, name), lambda *_: sys.exit("terminated"))
    with socket.create_server((given["host"], int(given["port"]))) as server:
        host, port = server.getsockname()
        print(f"waiting for a driver at {host}:{port}, a period of {side.period:g} s", flush=True)
        while True:
            connected, (driver, _) = server.accept()
            print(f"driven from {driver}", flush=True)
            side.serve(Connection(connected))


if __name__ == "__main__":
    try:
        main(*sys.argv[1:])
    except KeyboardInterrupt:
        sys.exit("stopped")
