"""The ROS 2 node of examples/, with a stand-in of rclpy: right commands, and rest where what it reads is no use."""

from __future__ import annotations

import importlib.util
import json
import re
import signal
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from folders import a_run
from pegasus_jax.exports.write import export

ROOT = Path(__file__).resolve().parents[1]
EXAMPLE = ROOT / "examples" / "ros2" / "policy_node.py"
STAND_INS = ROOT / "tests" / "stand_ins"
OBSERVE = ["position.cart", "velocity.cart", "velocity.pole", "position.pole"]


@pytest.fixture(scope="module")
def policy(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A controller of the cart-pole, as pegasus-export writes it."""
    home = tmp_path_factory.mktemp("ros2")
    return export(a_run(home / "run", trials=1), out=home / "policy.py")


@pytest.fixture
def ros(policy: Path, monkeypatch: pytest.MonkeyPatch) -> Any:
    """The example as a module, with the stand-in for ROS."""
    monkeypatch.syspath_prepend(str(STAND_INS))
    spec = importlib.util.spec_from_file_location("policy_node", EXAMPLE)
    assert spec
    assert spec.loader
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    given = {"controller": str(policy), "observe": OBSERVE}
    monkeypatch.setattr(sys.modules["rclpy.node"], "parameters", given)
    monkeypatch.setattr(sys.modules["rclpy"], "on_spin", [])
    clock = [0.0]  # [s] which only a test moves on
    made: Any = module
    made.given, made.clock, made.time = given, clock, SimpleNamespace(monotonic=lambda: clock[0])
    yield module
    for name in [name for name in sys.modules if name.split(".")[0] in {p.name for p in STAND_INS.iterdir()}]:
        del sys.modules[name]


def read(ros: Any, node: Any, x: Any, names: tuple[str, ...] = ("pole", "cart")) -> None:
    """Joint states of the cart-pole's [x, x', theta', theta]; ROS has the joints in any order."""
    values = {"cart": (x[0], x[1]), "pole": (x[3], x[2])}
    position, velocity = zip(*(values[name] for name in names), strict=True) if names else ((), ())
    node.subscriptions["joint_states"](ros.JointState(name=names, position=position, velocity=velocity))


def enable(ros: Any, node: Any, on: bool = True) -> Any:
    return node.services["~/enable"](ros.SetBool.Request(data=on), ros.SetBool.Response())


def tick(node: Any) -> list[float]:
    ((_, period),) = node.timers
    period()
    return node.publishers["commands"].sent[-1].data


def test_it_publishes_the_policys_controls_once_it_is_enabled(ros: Any, policy: Path) -> None:
    import runpy

    node, control = ros.PolicyNode(), runpy.run_path(str(policy))["Controller"]()
    assert node.timers[0][0] == 0.1
    assert "x [m], x' [m/s], theta' [rad/s], theta [rad] -> force [N] every 0.1 s" in node.logger.said[0]
    for x in np.random.default_rng(0).normal(size=(5, 4)):
        read(ros, node, x)
        assert tick(node) == [0.0]
    assert enable(ros, node).success
    for x in np.random.default_rng(1).normal(size=(20, 4)):
        read(ros, node, x)
        np.testing.assert_allclose(tick(node), control(x))
    assert enable(ros, node, False).message == "disabled"
    assert tick(node) == [0.0]


def test_limits_and_rest_are_parameters(ros: Any, policy: Path) -> None:
    import runpy

    control = runpy.run_path(str(policy))["Controller"]()
    ros.given |= {"low": [-0.1], "high": [0.05], "rest": [0.02]}
    node = ros.PolicyNode()
    assert tick(node) == [0.02]
    seen = np.random.default_rng(2).normal(size=(30, 4)) * 3
    read(ros, node, seen[0])
    enable(ros, node)
    for x in seen:
        read(ros, node, x)
        assert tick(node) == pytest.approx(np.clip(control(x), -0.1, 0.05))


def test_it_is_asked_for_a_goal_and_the_time(ros: Any, tmp_path: Path) -> None:
    """Of a controller that sends what it is given: enabled once there is a goal, and its time begins there."""
    (tmp_path / "follow.py").write_text("""
OBSERVATION, CONTROL, PERIOD = ("angle", "t", "goal 0"), ("a", "b", "c"), 0.1
class Controller:
    def reset(self): pass
    def __call__(self, x): return x
""")
    ros.given |= {"controller": str(tmp_path / "follow.py"), "observe": ["position.pole", "time", "asked.0"]}
    node = ros.PolicyNode()
    read(ros, node, [0.0, 0.0, 0.0, 3.0])
    assert enable(ros, node).message == "the topic asked has no asked.0"
    node.subscriptions["asked"](ros.Float64MultiArray(data=[0.5]))
    for _ in range(2):
        assert enable(ros, node).success
        assert [tick(node) for _ in range(3)] == [[3.0, pytest.approx(0.1 * i), 0.5] for i in range(3)]


@pytest.mark.parametrize(
    ("spoil", "says"),
    [
        (
            lambda ros, node: ros.clock.append(ros.clock.pop() + 0.06),
            "the newest joint states are 0.060 s old, more than 0.05 s",
        ),
        (lambda ros, node: read(ros, node, [0.0] * 4, ("pole",)), "the topic joint_states has no position.cart"),
        (lambda ros, node: read(ros, node, [np.nan] * 4), "4 finite numbers"),
    ],
)
def test_what_it_cannot_use_stops_it_until_it_is_enabled_again(ros: Any, spoil: Any, says: str) -> None:
    ros.given |= {"stale_after": 0.05, "rest": [0.25]}
    node = ros.PolicyNode()
    assert not enable(ros, node).success
    read(ros, node, [0.0] * 4)
    assert enable(ros, node).success
    assert tick(node) != [0.25]
    spoil(ros, node)
    assert tick(node) == [0.25]
    assert re.search(f"stopped: .*{says}.*; ~/enable starts again", node.logger.said[-1])
    read(ros, node, [0.0] * 4)
    assert tick(node) == [0.25]
    assert len(node.logger.said) == 2  # said once
    assert enable(ros, node).success
    assert tick(node) != [0.25]


@pytest.mark.parametrize("name", ["SIGINT", "SIGTERM", "SIGHUP"])
def test_it_ends_at_rest(ros: Any, name: str) -> None:
    """Published before the signal ends the connections."""
    nodes: list[Any] = []
    before = {sent: signal.getsignal(sent) for sent in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)}
    signal.signal(signal.SIGINT, signal.default_int_handler)

    def spun(node: Any) -> None:
        nodes.append(node)
        read(ros, node, [0.0] * 4)
        enable(ros, node)
        tick(node)
        signal.raise_signal(getattr(signal, name))

    sys.modules["rclpy"].on_spin.append(spun)  # type: ignore[attr-defined]
    try:
        ros.main()
    finally:
        for sent, handler in before.items():
            signal.signal(sent, handler)
    first, last = (message.data for message in nodes[0].publishers["commands"].sent)
    assert first != [0.0]
    assert last == [0.0]


@pytest.mark.parametrize(
    ("given", "says"),
    [
        ({"observe": OBSERVE[:3]}, r"observe has 3 entries; .* observes \('x \[m\]',"),
        (
            {"observe": ["angle.pole"] * 4},
            "observe has 'angle.pole'; expected position.JOINT, velocity.JOINT, effort.JOINT, asked.NUMBER or time",
        ),
        ({"low": [0.0, 0.0]}, "low has 2 entries; there are 1 controls"),
    ],
)
def test_parameters_that_cannot_be_are_one_line(ros: Any, given: dict[str, Any], says: str) -> None:
    ros.given |= given
    with pytest.raises(ValueError, match=says):
        ros.PolicyNode()


@pytest.mark.slow
def test_it_is_typed(tmp_path: Path) -> None:
    """By pyright, against the stand-in; a copy with a slip shows that it looks."""
    text = EXAMPLE.read_text()
    (tmp_path / "good.py").write_text(text)
    (tmp_path / "bad.py").write_text(text.replace("Float64MultiArray(data=", "Float64MultiArray(dats="))
    settings = {"include": ["."], "extraPaths": [str(STAND_INS)], "venvPath": str(ROOT), "venv": ".venv"}
    (tmp_path / "pyrightconfig.json").write_text(json.dumps(settings | {"typeCheckingMode": "standard"}))
    program = [sys.executable, "-m", "pyright", "--outputjson", "-p", str(tmp_path)]
    done = subprocess.run(program, capture_output=True, text=True, check=False)
    found = json.loads(done.stdout)["generalDiagnostics"]
    assert {Path(one["file"]).name for one in found} == {"bad.py"}, found
    assert "dats" in found[0]["message"]


def test_its_readme_has_its_commands_and_its_parameters() -> None:
    text = (EXAMPLE.parent / "README.md").read_text()
    code = EXAMPLE.read_text()
    declared = {*re.findall(r'declare_parameter\("(\w+)"|_numbers\("(\w+)"', code)}
    for name in {a or b for a, b in declared}:
        assert f"`{name}`" in text
    for name in ("policy_node.py", "joint_states", "commands", "/policy/enable", "std_srvs/srv/SetBool"):
        assert name in text
    assert "pegasus_jax" not in re.findall(r"^(?:from|import) (\w+)", code, re.MULTILINE)
