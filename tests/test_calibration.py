"""Calibration along an episode: 1 for a model that tells the truth about itself, proportional to its errors."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from pegasus_jax.assembly.experiments import compose
from pegasus_jax.models.calibration import calibration, filtered_errors
from pegasus_jax.types import Dynamics, Prediction, Trajectory
from probes import PENDULUM, PLAIN, cart, experience, known, network, noisy_linear_policy, regression, same, tiny

STEPS, STATES = 400, 2


def uncertain(function_std: float, noise_std: float) -> Dynamics:
    """A model whose change of state is an unknown constant of that spread, seen with that noise."""
    return known(PENDULUM)._replace(
        sample=lambda key, posterior: function_std * jax.random.normal(key, (STATES,)),
        apply=lambda posterior, draw, x, u: Prediction(draw, jnp.full((STATES,), noise_std)),
    )


def episode(std: float, seed: int = 0) -> Trajectory:
    """Changes of state that are independent, zero-mean and of that spread."""
    x = np.cumsum(np.random.default_rng(seed).normal(size=(STEPS + 1, STATES)) * std, 0)
    return Trajectory(jnp.asarray(x, float), jnp.zeros((STEPS, 1)), jnp.zeros(STEPS))


def found(model: Dynamics, trajectory: Trajectory, draws: int = 2000, angles: tuple[int, ...] = ()) -> float:
    return float(calibration(jax.random.key(3), None, trajectory, dynamics=model, angles=angles, draws=draws))


@pytest.mark.parametrize(("function_std", "noise_std"), [(0.0, 0.5), (0.5, 0.0), (0.3, 0.4)])
def test_a_model_whose_predictions_are_the_truth_is_calibrated(function_std, noise_std):
    """What it does not know and what it takes for noise count together: here both make .5."""
    assert found(uncertain(function_std, noise_std), episode(0.5)) == pytest.approx(1, abs=0.08)


@pytest.mark.parametrize("factor", [0.5, 2.0, 10.0])
def test_calibration_is_proportional_to_the_errors(factor):
    model = uncertain(0.0, 0.5)
    assert found(model, episode(0.5 * factor)) == pytest.approx(factor * found(model, episode(0.5)), rel=1e-4)


@pytest.mark.parametrize("factor", [1.0, 3.0])
def test_of_positions_alone_errors_of_computed_rates_do_not_count(factor):
    """A cart under noise `factor` times as large as its model says; its rates are differences."""
    dt, sensor, force, steps = 0.3, 0.03, 0.2, 2000
    a, b, draw = np.array([[1, dt], [0, 1]]), np.array([dt**2 / 2, dt]), np.random.default_rng(0)
    x, u = [np.zeros(2)], draw.uniform(-2, 2, steps)
    for control in u:
        x.append(a @ x[-1] + b * control + factor * force * draw.normal(size=2) * [dt / 2, 1])
    seen = np.array(x)[:, 0] + factor * sensor * draw.normal(size=steps + 1)
    rows = np.stack([seen, np.append(0, np.diff(seen)) / dt], 1)
    model = uncertain(0.0, 0.0)._replace(
        apply=lambda posterior, draw, x, u: Prediction(
            (a - np.eye(2)) @ x + b * u[0], jnp.array([sensor * np.sqrt(2), force])
        )
    )
    trajectory = Trajectory(jnp.asarray(rows, float), jnp.asarray(u[:, None], float), jnp.zeros(steps))
    by_filter = partial(filtered_errors, rates=(1,), dt=dt)
    ask = partial(calibration, posterior=None, trajectory=trajectory, dynamics=model, angles=(), draws=2)
    assert float(ask(jax.random.key(0), errors=by_filter)) == pytest.approx(factor, rel=0.06)
    assert float(ask(jax.random.key(1))) > 1.5 * factor


def test_a_few_wild_steps_do_not_decide():
    wild = episode(0.5)
    wild = wild._replace(x=wild.x.at[: STEPS // 20].multiply(1e3))
    assert found(uncertain(0.0, 0.5), wild) == pytest.approx(1, abs=0.15)


def test_an_angle_that_crosses_the_seam_is_no_error():
    """The same angles, written in (-pi, pi]."""
    turning = episode(0.5)._replace(x=jnp.linspace(0, 40, STEPS + 1)[:, None] * jnp.ones(STATES))
    seen = turning._replace(x=jnp.arctan2(jnp.sin(turning.x), jnp.cos(turning.x)))
    model = uncertain(0.0, 0.5)
    assert found(model, seen, angles=(0, 1)) == pytest.approx(found(model, turning), rel=1e-3)


def test_few_draws_say_nearly_the_same():
    """50 draws, each a function along the whole episode, as in a run."""
    model, data = network(), experience(rows=30)
    posterior = jax.jit(lambda: model.posterior(model.init(jax.random.key(1)), data))()
    trajectory = Trajectory(jnp.concatenate([data.x[:30], data.x[29:30] + data.y[29:30]]), data.u[:30], jnp.zeros(30))

    @partial(jax.jit, static_argnums=1)
    def ask(key, draws):
        return calibration(key, posterior, trajectory, dynamics=model, angles=(2,), draws=draws)

    assert float(ask(jax.random.key(0), 50)) == pytest.approx(float(ask(jax.random.key(1), 2000)), rel=0.2)


def test_of_an_experiment_it_is_unknown_before_there_are_data_and_changes_nothing():
    task = cart()
    exp = compose(
        tiny(fit__steps=5, search__steps=2, **PLAIN), task, dynamics=regression(2, 1), policy=noisy_linear_policy(task)
    )
    state = exp.init(jax.random.key(0))
    collect, add_episode, calibrate = (jax.jit(f) for f in (exp.collect, exp.add_episode, exp.calibrate))
    assert np.isnan(calibrate(state, collect(state)))
    after = add_episode(state, collect(state))
    flown = collect(after)
    assert np.isfinite(calibrate(after, flown))
    assert same(flown, collect(after))
    assert calibrate(after, flown) == calibrate(after, flown)


@pytest.mark.parametrize("length", [None, STEPS, 6])
def test_a_model_that_predicts_nan_is_not_calibrated(length):
    """Rows after an episode's end do not count; a NaN of the model is no such row."""
    model = uncertain(0.0, 0.5)
    broken = model._replace(apply=lambda *given: Prediction(model.apply(*given).mean.at[0].set(jnp.nan), jnp.ones(2)))
    ran = episode(0.5)._replace(length=None if length is None else jnp.int32(length))
    assert np.isnan(found(broken, ran))
    assert np.isfinite(found(model, ran._replace(x=ran.x.at[7 if length == 6 else STEPS + 1].set(jnp.nan))))


@pytest.mark.parametrize("length", [None, 6])
def test_what_is_known_exactly_says_nothing(length):
    """An entry that never changes, and of which a model without noise knows that, is 0 / 0."""
    still = episode(0.5)._replace(length=None if length is None else jnp.int32(length))
    still = still._replace(x=still.x.at[:, 0].set(1.0))
    exact = known(PENDULUM)._replace(
        sample=lambda key, posterior: jnp.zeros(STATES),
        apply=lambda posterior, draw, x, u: Prediction(jnp.zeros(STATES), jnp.array([0.0, 0.5])),
    )
    assert 0.2 < found(exact, still) < 3
