"""A ROS 2 node that drives joints by a controller which pegasus-export has written. It needs NumPy, not pegasus_jax.

    pegasus-export runs/arm out=arm_policy.py
    python3 policy_node.py --ros-args -p controller:=arm_policy.py -p observe:="['position.elbow','velocity.elbow']"
    ros2 service call /policy/enable std_srvs/srv/SetBool "{data: true}"

Each period it turns the newest sensor_msgs/JointState into a std_msgs/Float64MultiArray, one number a control. It
publishes rest, and is disabled until somebody enables it again, where that message is too old, lacks a joint, or holds
what is no number. It begins disabled, says its contract, and then only publishes rest: a dry run.
"""

import runpy
import time
from typing import Any

import numpy as np
import rclpy
from rclpy.node import Node
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64MultiArray
from std_srvs.srv import SetBool

PARTS = ("position", "velocity", "effort")


class PolicyNode(Node):
    """Parameters, besides the topics `joint_states` and `commands`, which ROS can remap:

    controller: the file of `pegasus-export RUN format=numpy`
    observe: what each entry of an observation is, as position.elbow or velocity.elbow, in the controller's order
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
        self.entries = [self._entry(text) for text in self.declare_parameter("observe", [""]).value]
        if len(self.entries) != len(module["OBSERVATION"]):
            raise ValueError(f"observe has {len(self.entries)} entries; {path} observes {module['OBSERVATION']}")
        self.low, self.high = self._numbers("low", count, -np.inf), self._numbers("high", count, np.inf)
        self.rest = self._numbers("rest", count, 0.0)
        self.stale_after = float(self.declare_parameter("stale_after", 0.0).value) or 3 * self.period
        self.enabled, self.newest, self.came = False, None, 0.0
        self.publisher = self.create_publisher(Float64MultiArray, "commands", 1)
        self.create_subscription(JointState, "joint_states", self.on_joints, 1)
        self.create_service(SetBool, "~/enable", self.on_enable)
        self.create_timer(self.period, self.on_period)
        self.get_logger().info(
            f"{path}: {', '.join(module['OBSERVATION'])} -> {', '.join(module['CONTROL'])} every {self.period:g} s;"
            " disabled until ~/enable"
        )

    def _entry(self, text: str) -> tuple[str, str]:
        part, _, joint = text.partition(".")
        if part not in PARTS or not joint:
            raise ValueError(f"observe has {text!r}; expected position.JOINT, velocity.JOINT or effort.JOINT")
        return part, joint

    def _numbers(self, name: str, count: int, default: float) -> np.ndarray:
        """A parameter of one number a control. NaN, as ROS has no empty list of numbers, is the default."""
        values = np.array(self.declare_parameter(name, [float("nan")]).value, float)
        if len(values) != count and not np.isnan(values).all():
            raise ValueError(f"{name} has {len(values)} entries; there are {count} controls")
        return np.full(count, default) if np.isnan(values).all() else values

    def on_joints(self, message: JointState) -> None:
        self.newest, self.came = message, time.monotonic()

    def on_enable(self, request: SetBool.Request, response: SetBool.Response) -> SetBool.Response:
        """Enable or disable; where nothing fresh was read it stays disabled."""
        self.enabled, response.message = False, "disabled"
        if request.data:
            try:
                self.observation()
                self.control.reset()
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
        seen = []
        for part, joint in self.entries:
            values: Any = getattr(message, part)
            if joint not in message.name or list(message.name).index(joint) >= len(values):
                raise ValueError(f"the joint states have no {part} of {joint}")
            seen.append(float(values[list(message.name).index(joint)]))
        return seen

    def on_period(self) -> None:
        """Publish a control, or rest."""
        u = self.rest
        if self.enabled:
            try:
                u = np.clip(self.control(self.observation()), self.low, self.high)  # ValueError for what is no number
            except ValueError as error:
                self.stop(str(error))
        self.publish(u)

    def stop(self, why: str) -> None:
        self.enabled = False
        self.get_logger().error(f"stopped: {why}; ~/enable starts again")

    def publish(self, u: np.ndarray) -> None:
        self.publisher.publish(Float64MultiArray(data=[float(value) for value in u]))


def main() -> None:
    rclpy.init()
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
