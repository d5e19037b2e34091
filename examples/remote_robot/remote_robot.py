"""A robot in another process, or on another computer, as a Gymnasium environment for any pegasus command.

    pegasus-train task=gym env=remote_robot:Remote-v0 env_args.host=127.0.0.1 env_args.port=5555 \
        cost=remote_robot:cost angles=[0] start_mean=[3.14,0] start_std=[0.05] \
        horizon=60 trials=8 explore.kind=walk eval_episodes=0 out=runs/remote

`robot_side.py` is the other end, `messages.py` says what passes between them. Limits, period, names and units are the
robot's own.
"""

import contextlib
import socket

import gymnasium
import jax.numpy as jnp
import numpy as np
from messages import PROTOCOL, Connection

PATIENCE = 60.0  # seconds that a reset may take: somebody may have to put the robot back


class Remote(gymnasium.Env):
    """The robot at host:port; `timeout` seconds, by default 10 periods and at least .5, without an answer end a run."""

    def __init__(self, host: str = "127.0.0.1", port: int = 5555, timeout: float | None = None):
        self.where, self.number, self._robot = f"{host}:{port}", 0, None
        try:
            self._robot = Connection(socket.create_connection((host, port), timeout=5))
            about = self._robot.receive(5)
        except TimeoutError as error:
            self._let_go()
            raise TimeoutError(f"the robot at {self.where} does not answer; does somebody else drive it?") from error
        except (OSError, ValueError) as error:
            self._let_go()
            raise ConnectionError(f"no robot at {self.where}, {error}; start robot_side.py there") from error
        if about.get("protocol") != PROTOCOL:
            raise ValueError(f"the robot at {self.where} speaks protocol {about.get('protocol')}, not {PROTOCOL}")
        self.dt, self.timeout = about["period"], timeout or max(0.5, 10 * about["period"])
        self.state_names, self.control_names = tuple(about["state_names"]), tuple(about["control_names"])
        self.observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (len(self.state_names),), np.float64)
        self.action_space = gymnasium.spaces.Box(np.array(about["low"]), np.array(about["high"]), dtype=np.float64)

    def reset(self, *, seed=None, options=None):
        self.number = 0
        answer = self._ask({"do": "reset", "seed": seed}, PATIENCE)
        return np.array(answer["observation"]), {"time": answer["time"]}

    def step(self, control):
        self.number += 1
        answer = self._ask({"do": "control", "control": np.asarray(control, float).tolist()}, self.timeout)
        return np.array(answer["observation"]), 0.0, False, False, {"time": answer["time"]}

    def rest(self):
        """Stop the motors: no control comes until the next reset."""
        self.number += 1
        self._ask({"do": "stop"}, 1.0)

    def close(self):
        """Stop the motors, as far as the connection allows; the robot stops them by itself when it ends."""
        if self._robot is not None:
            with contextlib.suppress(OSError, ValueError):
                self.rest()
            self._let_go()

    def _ask(self, question, seconds):
        """The robot's answer to a question. Where there is none the connection is ended, and so the motors stop."""
        what = f"the robot at {self.where}"
        if self._robot is None:
            raise ConnectionError(f"{what} is not connected any more")
        try:
            self._robot.send(question | {"number": self.number})
            answer = self._robot.receive(seconds)
        except TimeoutError as error:
            self._let_go()
            raise TimeoutError(f"{what} has not answered {question['do']} {self.number} for {seconds:g} s") from error
        except OSError as error:
            self._let_go()
            raise ConnectionError(f"{what} was lost at {question['do']} {self.number}, {error}") from error
        except BaseException:  # Ctrl-C: an answer that comes later would be taken for that of the next question
            self._let_go()
            raise
        if "error" in answer or answer.get("number") != self.number:
            self._let_go()
            raise ValueError(f"{what} answered {question['do']} {self.number} by {answer}")
        return answer

    def _let_go(self):
        if self._robot is not None:
            self._robot.close()
            self._robot = None


gymnasium.register("Remote-v0", Remote)


def cost(x):
    """Of one observation [2]: 0 upright, near 1 hanging. In JAX, because the search differentiates it."""
    return 1 - jnp.exp(-2 * (1 - jnp.cos(x[0])))
