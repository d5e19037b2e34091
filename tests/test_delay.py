"""pegasus-delay: the delay that a plant has is the one that is found, and how sure that is; the robot ends at rest."""

from __future__ import annotations

import dataclasses
from collections import deque
from typing import Any

import gymnasium
import numpy as np
import pytest

from pegasus_jax import tasks
from pegasus_jax.checks import ConfigError, RunError, whole
from pegasus_jax.cli.delay import handle
from pegasus_jax.math.delays import delay_of
from pegasus_jax.runs import config_io
from pegasus_jax.runs.delay import Measured, announced, measure, planned, told


class Late(gymnasium.ActionWrapper):
    """The cart-pole of pegasus_envs, driven by the control of so many periods ago, maybe with only positions read."""

    def __init__(self, delay: int = 0, positions: bool = False):
        super().__init__(gymnasium.make("pegasus_envs:pegasus/CartPoleSwingUp-v0"))
        self.delay, self.entries = delay, [0, 3] if positions else [0, 1, 2, 3]
        self.observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (len(self.entries),))
        self.state_names = tuple(self.env.get_wrapper_attr("state_names")[i] for i in self.entries)

    def reset(self, **options: Any) -> Any:
        self.queue = deque([np.zeros(1, np.float32)] * self.delay)
        x, info = self.env.reset(**options)
        return x[self.entries], info

    def step(self, action: Any) -> Any:
        self.queue.append(action)
        x, *rest = self.env.step(self.queue.popleft())
        return x[self.entries], *rest


class Motor(gymnasium.Env):
    """A rate that the control drives, at a quantized angle; the last control is read too. What it was sent is kept."""

    observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (2,))
    dt, state_names, control_names = 0.02, ("angle [rad]", "last volts [V]"), ("voltage [V]",)
    sent: list[float] = []  # noqa: RUF012
    closed = 0

    def __init__(self, gain: float = 1.0, fails: int = -1, falls: int = -1, low: float = -1.0, high: float = 3.0):
        self.gain, self.fails, self.falls = gain, fails, falls
        self.action_space = gymnasium.spaces.Box(low, high, (1,))

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        super().reset(seed=seed)
        self.angle, self.rate, self.late, self.count = 0.0, 0.0, 0.0, 0
        return np.zeros(2), {}

    def step(self, control: Any) -> Any:
        self.count += 1
        if self.count == self.fails:
            raise OSError("no motor answers")
        Motor.sent.append(float(control[0]))
        self.rate += self.gain * self.late - 0.1 * self.rate + 0.01 * self.np_random.normal()
        self.late, self.angle = float(control[0]), self.angle + self.rate
        return np.array([round(self.angle, 1), control[0]]), 0.0, self.count == self.falls, False, {}

    def close(self) -> None:
        Motor.closed += 1


for name, kind in (("Late-v0", Late), ("Motor-v0", Motor)):
    gymnasium.register(name, kind)


@pytest.fixture(autouse=True)
def fresh() -> Any:
    Motor.sent.clear()
    Motor.closed = 0
    yield
    tasks.close_environments()


def config(**words: str) -> Any:
    return config_io.parse({"task": "gym", **words})


def measured(config: Any, **options: Any) -> Measured:
    return measure(planned(config, **options))


@pytest.mark.parametrize("positions", [False, True])
@pytest.mark.parametrize("delay", [0, 1, 2])
def test_the_delay_of_a_cart_pole_is_found(delay: int, positions: bool) -> None:
    given = {"env_args.delay": str(delay), "env_args.positions": str(positions).lower()}
    angle = "[1]" if positions else "[3]"
    found = measured(config(env="Late-v0", angles=angle, horizon="25", **given), amplitude=0.2, periods=300)
    assert found.delay.periods == delay
    assert found.delay.probabilities[delay] > 0.9
    assert found.delay.probabilities.sum() == pytest.approx(1)
    line = told(found)
    assert line.startswith(f"Late-v0: delay {delay} {'period' if delay == 1 else 'periods'}, {0.1 * delay:g} s (")
    assert line.endswith(f"; give sensors.delay={delay}" if delay else "; no sensors.delay= is needed")


def test_a_motor_is_moved_a_little_and_ends_at_rest() -> None:
    """Its limits are -1 and 3; the last control, which it reads, is no proof of a delay of 0."""
    found = measured(config(env="Motor-v0", horizon="60"), amplitude=0.1, periods=100)
    assert {*np.round(Motor.sent, 6)} == {-0.2, 0.2, 0.0}
    ends = [Motor.sent[60], Motor.sent[-1]]
    assert (len(Motor.sent), ends, Motor.sent.count(0.0), Motor.closed) == (101, [0.0, 0.0], 2, 1)
    assert (found.delay.periods, found.delay.echoes, found.delay.rows) == (1, (1,), 101 - 2 * 8)
    line = told(measured(config(env="Motor-v0"), periods=400))
    assert line.endswith("; give sensors.delay=1; not looked at, because it repeats a control: last volts [V]")


def test_where_nothing_answers_it_offers_more_periods_before_larger_controls() -> None:
    still = config(env="Motor-v0", **{"env_args.gain": "0"})
    line = told(measured(still, amplitude=0.1, periods=400))
    assert "no change follows from the controls in " in line
    assert "; type periods=1600, and if that is not enough amplitude=0.2" in line
    assert "nearest" not in line
    assert "amplitude=" not in told(measured(still, amplitude=1.0, periods=400))
    assert whole("periods", "20000") == 20000  # what it offers it takes


def test_a_delay_that_is_not_sure_is_no_answer() -> None:
    """Of probabilities on both sides of the bound; that there is no change may be as unsure."""
    found = measured(config(env="Motor-v0"), periods=100)
    for chances, expected in (
        ((0.0, 0.18, 0.42, 0.30, 0.10), "2 periods with probability 0.42, 3 periods with 0.30, 1 period with 0.18"),
        ((0.0, 0.3, 0.0, 0.0, 0.7), "no change with probability 0.70, 1 period with 0.30 ("),
        ((0.89, 0.11, 0.0, 0.0, 0.0), "0 periods with probability 0.89, 1 period with 0.11 ("),
    ):
        line = told(found._replace(delay=found.delay._replace(probabilities=np.array(chances))))
        assert f"the delay is not sure yet: {expected}" in line
        assert " periods); type periods=400, and if that is not enough amplitude=0.4" in line
        assert "sensors.delay" not in line
    sure = found.delay._replace(probabilities=np.array([0.0, 0.0, 0.91, 0.09, 0.0]), periods=2)
    assert "; give sensors.delay=2" in told(found._replace(delay=sure))


@pytest.mark.parametrize(
    ("low", "high", "amplitude", "expected"),
    [(-1, 3, 1.0, "-1 or 2"), (0, 5, 0.8, "0 or 2"), (1, 5, 0.5, "1 or 2"), (-5, -1, 0.5, "-2 or -1")],
)
def test_what_will_be_sent_is_said(low: float, high: float, amplitude: float, expected: str) -> None:
    """And is what is sent; the range clips it, and nothing has moved yet."""
    plan = planned(config(env="Motor-v0", **{"env_args.low": str(low), "env_args.high": str(high)}), amplitude, 100)
    line = announced(plan)
    assert line.startswith(f"Motor-v0: sends voltage [V] of {expected}, a new draw in each of 100 periods of 0.02 s")
    assert "\n" not in line
    assert Motor.sent == []
    measure(plan)
    rest = min(max(0, low), high)
    assert {f"{u:.4g}" for u in Motor.sent} == {*expected.split(" or "), str(rest)}


class Steps(Motor):
    """The same, of whole volts."""

    def __init__(self, **options: Any):
        super().__init__(**options)
        self.action_space = gymnasium.spaces.Box(-2, 2, (1,), np.int32)


gymnasium.register("Steps-v0", Steps)


def test_whole_numbers_are_said_as_they_are_sent() -> None:
    plan = planned(config(env="Steps-v0"), 0.7, 100)
    assert announced(plan).startswith("Steps-v0: sends voltage [V] of -1 or 1, a new draw")
    measure(plan)
    assert {*Motor.sent} == {-1.0, 0.0, 1.0}
    with pytest.raises(ConfigError) as refused:
        planned(config(env="Steps-v0"), 0.2, 100)
    nearest = float(str(refused.value).rpartition("amplitude=")[2])
    assert "amplitude=0.2 is too small for whole numbers: voltage [V] of 0 only; type" in str(refused.value)
    assert np.ptp(planned(config(env="Steps-v0"), nearest, 100).sent) > 0


def test_a_limit_on_the_rate_of_change_is_said_and_how_to_lift_it() -> None:
    """From one limit of the range, rest, a control may go as far as from one value to the other."""
    for low, expected, moves in ((0, "0 or 0.2", 2.0), (-5, "-0.1 or 0.1", 8.0)):
        words = {"env": "Motor-v0", "env_args.low": str(low), "env_args.high": "5"}
        plan = planned(config(control_rate="10", **words), 0.8, 100)
        first, second = announced(plan).split("\n")
        assert f"sends voltage [V] of {expected}, a new draw" in first
        assert second == (
            f"note: control_rate=10 lets voltage [V] change by 0.2 a period, not {moves:g}, which amplitude=0.8 asks"
            f" for; type control_rate={moves / 0.02:g}, or leave it out"
        )
        unsure = measure(plan)
        unsure = unsure._replace(delay=unsure.delay._replace(probabilities=np.full(10, 0.1)))
        assert f"type periods=400, and if that is not enough control_rate={moves / 0.02:g}" in told(unsure)
        lifted = planned(config(control_rate=f"{moves / 0.02:g}", **words), 0.8, 100)
        assert "note: " not in announced(lifted)
        np.testing.assert_allclose(np.ptp(lifted.sent, axis=0), moves)


def test_where_episodes_end_early_others_follow() -> None:
    """Until there are rows enough, and no longer."""
    found = measured(config(env="Motor-v0", **{"env_args.falls": "20"}), amplitude=0.2, periods=67)
    assert found.delay.rows == 4 * 12 + 12  # 59 are enough, and each ends with a period of rest
    assert len(Motor.sent) == 5 * 20
    assert found.delay.periods == 1


def test_noise_alone_has_no_delay() -> None:
    """By chance one in some hundred tries would be allowed."""
    draw = np.random.default_rng(0)
    walks = [(np.cumsum(draw.normal(size=(151, 3)), 0), draw.choice([-1.0, 1.0], (150, 1))) for _ in range(50)]
    assert sum(delay_of([walk]).periods is not None for walk in walks) <= 1
    still = delay_of([(np.zeros((151, 2)), walks[0][1])])
    assert still.periods is None
    assert still.probabilities[-1] == 1


def test_an_answer_that_is_drowned_by_noise_is_less_sure() -> None:
    """A delay of 2 in sensors whose noise grows: the probability of the truth falls, that of nothing rises."""
    draw, stds = np.random.default_rng(1), (0.01, 3.0, 30.0)
    chances = np.zeros((3, 10))
    for _ in range(20):
        u = draw.choice([-1.0, 1.0], (300, 1))
        x = np.cumsum(np.concatenate([np.zeros((3, 1)), u[:-2]]), 0)
        chances += [delay_of([(x + std * draw.normal(size=x.shape), u)]).probabilities / 20 for std in stds]
    truth, nothing = chances[:, 2], chances[:, -1]
    assert truth[0] > 0.8
    assert nothing[0] < 1e-6
    assert nothing[2] > 0.8
    assert (np.diff(truth) < 0).all()
    assert (np.diff(nothing) > 0).all()


def test_an_angle_may_pass_half_a_turn() -> None:
    draw = np.random.default_rng(2)
    u = draw.choice([-1.0, 1.0], (200, 2))
    angle = (
        np.pi + np.cumsum(np.concatenate([np.zeros((2, 1)), 0.3 * u[:-1, 1:]]), 0) + 0.01 * draw.normal(size=(201, 1))
    )
    wrapped = np.angle(np.exp(1j * angle))
    assert delay_of([(wrapped, u)], angles=[0]).probabilities[1] > 0.99


def test_what_cannot_be_is_one_line_and_moves_nothing() -> None:
    for words, complaint in (
        (["env=Motor-v0", "amplitude=0"], r"amplitude=0 is out of range; expected a number in \(0, 1\]"),
        (["env=Motor-v0", "amplitude=some"], "amplitude=some is not a number; for example amplitude=0.2"),
        (["env=Motor-v0", "periods=60"], r"periods=60 is out of range; expected a number in \[67, 1000000\]"),
        (["env=Motor-v0", "most=0"], "most=0 is out of range"),
        (["env=Motor-v0", "horizon=8"], r"horizon=8 is out of range; expected a number in \[9, inf"),
        (["env=Motor-v0", "ampltude=1"], "did you mean 'amplitude'"),
        (["amplitude=0.1"], "pegasus-delay drives an environment; for example env=robot:Arm-v0"),
        (["env=Motor-v9"], "env=Motor-v9: "),
    ):
        with pytest.raises(ConfigError, match=complaint) as refused:
            handle(words)
        assert "\n" not in str(refused.value)
    assert Motor.sent == []


def test_a_robot_that_fails_is_closed() -> None:
    with pytest.raises(RunError, match=r"Motor-v0 failed in an episode, OSError: no motor answers"):
        measured(config(env="Motor-v0", **{"env_args.fails": "5"}))
    assert Motor.closed == 1


@pytest.mark.parametrize(
    ("falls", "episodes", "rows", "words"),
    [(5, 20, 0, "most=2, or amplitude=0.1"), (2, 20, 0, "amplitude=0.1"), (10, 17, 34, "most=6, or amplitude=0.1")],
)
def test_episodes_that_are_too_short_are_refused_with_what_would_do(
    falls: int, episodes: int, rows: int, words: str
) -> None:
    """Sooner where what is left of three times the periods cannot be enough; and what it says to type does it."""
    short = config(env="Motor-v0", **{"env_args.falls": str(falls)})
    with pytest.raises(ConfigError) as refused:
        measured(short, periods=67)
    assert str(refused.value) == (
        f"Motor-v0: its {episodes} episodes end too early, the longest after {falls} periods: {rows} of their periods"
        f" have 8 before them, and 59 are needed; type {words} for longer ones"
    )
    assert (len(Motor.sent), Motor.closed) == (episodes * falls, 1)
    if words.startswith("most="):
        assert measured(short, periods=67, most=int(words[5])).delay.rows > 50


def test_it_takes_the_words_of_a_run(capsys: pytest.CaptureFixture[str]) -> None:
    """Of which those of learning are of no use, and harm nothing."""
    handle(["env=Motor-v0", "cost=nowhere:cost", "start_mean=[0,0]", "control_high=[1]", "amplitude=0.5", "most=4"])
    assert {*np.round(Motor.sent, 6)} == {-0.5, 0.5, 0.0}
    said = capsys.readouterr()
    assert (said.out.count("\n"), said.err.count("\n")) == (1, 1)
    assert said.err.startswith("Motor-v0: sends voltage [V] of -0.5 or 0.5, ")
    assert dataclasses.asdict(config(env="Motor-v0"))["cost"] is None
