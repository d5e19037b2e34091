"""A ROS 2 node that drives joints by a controller which pegasus-export has written. It needs NumPy, not pegasus_jax.

    pegasus-export runs/arm out=arm_policy.py
    python3 policy_node.py --ros-args -p controller:=arm_policy.py -p observe:="['position.elbow','velocity.elbow']"
    ros2 service call /policy/enable std_srvs/srv/SetBool "{data: true}"

Each period it turns the newest sensor_msgs/JointState into a std_msgs/Float64MultiArray, one number a control. It
publishes rest, and is disabled until somebody enables it again, where that message is too old, lacks a joint, or holds
what is no number. It begins disabled, says its contract, and then only publishes rest: a dry run.
"""

import re
import runpy
import signal
import time
from typing import Any

import numpy as np
import rclpy
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64MultiArray
from std_srvs.srv import SetBool

PARTS = ("position", "velocity", "effort")


class PolicyNode(Node):
    """Parameters, besides the topics `joint_states`, `asked` and `commands`, which ROS can remap:

    controller: the file of `pegasus-export RUN format=numpy`
    observe: what each entry of an observation is, as position.elbow or velocity.elbow, in the controller's order; a
        goal or a reference is asked.0, asked.1, ..., the newest numbers of the topic `asked`; time is that since it was
        enabled [s]
    low, high: limits of the controls; left out, those of the controller
    rest: what is published while disabled; left out, zeros
    stale_after: seconds after which a message is too old; 0: three periods
    """

    def __init__(self) -> None:
        super().__init__("policy")
        path = self.declare_parameter("controller", "controller.py").value
        module = runpy.run_path(path)
        self.control, self.period = module["Controller"](), float(module["PERIOD"])
        count = len(module["CONTROL"])
        self.entries = list(self.declare_parameter("observe", [""]).value)
        for entry in self.entries:
            if not re.fullmatch(rf"({'|'.join(PARTS)})\..+|asked\.\d+|time", entry):
                expected = ", ".join(f"{part}.JOINT" for part in PARTS)
                raise ValueError(f"observe has {entry!r}; expected {expected}, asked.NUMBER or time")
        if len(self.entries) != len(module["OBSERVATION"]):
            raise ValueError(f"observe has {len(self.entries)} entries; {path} observes {module['OBSERVATION']}")
        self.low, self.high = self._numbers("low", count, -np.inf), self._numbers("high", count, np.inf)
        self.rest = self._numbers("rest", count, 0.0)
        self.stale_after = float(self.declare_parameter("stale_after", 0.0).value) or 3 * self.period
        self.enabled, self.newest, self.came = False, None, 0.0
        self.asked, self.periods = [], 0  # the newest numbers; periods since it was enabled
        self.publisher = self.create_publisher(Float64MultiArray, "commands", 1)
        self.create_subscription(JointState, "joint_states", self.on_joints, 1)
        self.create_subscription(Float64MultiArray, "asked", self.on_asked, 1)
        self.create_service(SetBool, "~/enable", self.on_enable)
        self.create_timer(self.period, self.on_period)
        self.get_logger().info(
            f"{path}: {', '.join(module['OBSERVATION'])} -> {', '.join(module['CONTROL'])} every {self.period:g} s;"
            " disabled until ~/enable"
        )

    def _numbers(self, name: str, count: int, default: float) -> np.ndarray:
        """A parameter of one number a control. NaN, as ROS has no empty list of numbers, is the default."""
        values = np.array(self.declare_parameter(name, [float("nan")]).value, float)
        if len(values) != count and not np.isnan(values).all():
            raise ValueError(f"{name} has {len(values)} entries; there are {count} controls")
        return np.full(count, default) if np.isnan(values).all() else values

    def on_joints(self, message: JointState) -> None:
        self.newest, self.came = message, time.monotonic()

    def on_asked(self, message: Float64MultiArray) -> None:
        self.asked = message.data

    def on_enable(self, request: SetBool.Request, response: SetBool.Response) -> SetBool.Response:
        """Enable or disable; where nothing fresh was read it stays disabled."""
        self.enabled, response.message = False, "disabled"
        if request.data:
            try:
                self.observation()
                self.control.reset()
                self.periods = 0
                self.enabled, response.message = True, "enabled"
            except ValueError as error:
                response.message = str(error)
        response.success = self.enabled == request.data
        return response

    def observation(self) -> list[float]:
        """The newest reading, in the controller's order. Raises ValueError, in one line, where there is none to use."""
        message, age = self.newest, time.monotonic() - self.came
        if message is None:
            raise ValueError("no joint states have come")
        if age > self.stale_after:
            raise ValueError(f"the newest joint states are {age:.3f} s old, more than {self.stale_after:g} s")
        read: dict[str, Any] = {"time": self.periods * self.period}
        read |= {f"asked.{i}": value for i, value in enumerate(self.asked)}
        for part in PARTS:  # one that is not measured is empty
            pairs = zip(message.name, getattr(message, part), strict=False)
            read |= {f"{part}.{joint}": value for joint, value in pairs}
        for entry in self.entries:
            if entry not in read:
                topic = "asked" if entry.startswith("asked.") else "joint_states"
                raise ValueError(f"the topic {topic} has no {entry}")
        return [float(read[entry]) for entry in self.entries]

    def on_period(self) -> None:
        """Publish a control, or rest."""
        u = self.rest
        if self.enabled:
            try:
                u = np.clip(self.control(self.observation()), self.low, self.high)  # ValueError for what is no number
                self.periods += 1
            except ValueError as error:
                self.stop(str(error))
        self.publish(u)

    def stop(self, why: str) -> None:
        self.enabled = False
        self.get_logger().error(f"stopped: {why}; ~/enable starts again")

    def publish(self, u: np.ndarray) -> None:
        self.publisher.publish(Float64MultiArray(data=[float(value) for value in u]))


def main() -> None:
    # ROS's own handlers would end the connections first, so that rest could not be published.
    rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
    for name in {"SIGTERM", "SIGHUP"} & {*dir(signal)}:
        signal.signal(getattr(signal, name), signal.default_int_handler)
    node = PolicyNode()
    try:
        rclpy.spin(node)
    except KeyboardInterrupt:
        pass
    finally:
        node.publish(node.rest)
        node.destroy_node()
        rclpy.try_shutdown()


if __name__ == "__main__":
    main()
