"""Models fitted to positions: these are as likely as all equations have them, and under the true model likeliest."""

from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from pegasus_jax import memory as recall
from pegasus_jax.assembly.experiments import compose
from pegasus_jax.config import BNN, Lagrangian, Sensors
from pegasus_jax.experiment import CALIBRATE, trial_key
from pegasus_jax.models.bnn import bnn
from pegasus_jax.models.calibration import calibration, filtered_errors
from pegasus_jax.models.dropout import binary
from pegasus_jax.models.innovations import DEGREES_OF_FREEDOM, WINDOW, filtered, innovations, integrated, windows
from pegasus_jax.models.lagrangian import lagrangian
from pegasus_jax.types import Batch, Dataset, Prediction
from probes import cart, tiny

DT = 0.3
A, B = np.array([[1, DT], [0, 1]]), np.array([DT**2 / 2, DT])  # the probe's cart


def measured(lengths=(4, 3), capacity=9, seed=0, rates=0.5):
    """The probe's cart in episodes of these lengths: its data, positions with noise of 3 cm and rates far off."""
    draw, rows = np.random.default_rng(seed), []
    for length in lengths:
        state = draw.normal(size=2)
        x, u = [state], draw.uniform(-2, 2, length)
        for control in u:
            x.append(A @ x[-1] + B * control + draw.normal() * 0.2 * np.array([DT / 2, 1]))
        seen = np.array(x) + draw.normal(size=(length + 1, 2)) * [0.03, rates]
        flags = np.arange(length) == 0
        rows += list(zip(seen[:-1], np.column_stack([u, flags]), np.diff(seen, axis=0), strict=True))
    columns = [np.concatenate([np.array(c), np.zeros((capacity - len(rows), 2))]) for c in zip(*rows, strict=True)]
    return Dataset(*map(jnp.asarray, columns), jnp.int32(len(rows)))


def along(predict, data, spread, angles=()):
    """`filtered(...).nats` of all rows in use, as one window."""
    rows = int(data.size)
    given = Batch(data.x[:rows], data.u[:rows, :1], data.y[:rows])
    return filtered(predict, given, data.u[:rows, 1] > 0.5, spread, rates=(1,), angles=angles, dt=DT).nats


def cart_of(std, gain=1.0):
    """The cart, whose control has this gain."""
    return lambda x, u: Prediction((A - np.eye(2)) @ x + gain * B * u[0], jnp.asarray(std))


def by_least_squares(x, u, last, sensor, force, spread):
    """Mean and covariance of the last state of an episode [L + 1, 2], from all its equations at once."""
    length = len(x)
    equations, values = [], []

    def add(at, left, right, std):
        row = np.zeros(2 * (length + 1))
        for t, part in zip(at, left, strict=True):
            row[2 * t : 2 * t + 2] = part
        equations.append(row / std)
        values.append(right / std)

    add([0], [[0, 1]], x[0, 1], np.sqrt(spread))
    for t, position in enumerate([*x[:, 0], last]):
        add([t], [[1, 0]], position, sensor)
    for t in range(length):
        for i, std in enumerate((force * DT / 2, force)):
            add([t, t + 1], [-A[i], np.eye(2)[i]], B[i] * u[t], std)
    lhs, rhs = np.array(equations), np.array(values)
    cov = np.linalg.inv(lhs.T @ lhs)
    return (cov @ lhs.T @ rhs)[-2:], cov[-2:, -2:]


def test_each_position_is_as_likely_as_all_equations_before_it_have_it(x64):
    """Of two episodes in one window: the second begins anew."""
    data, sensor, force, spread = measured(), 0.03, 0.2, 1.7
    found = along(cart_of([sensor * np.sqrt(2), force]), data, jnp.array([spread]))
    x, u, y = (np.asarray(column) for column in data[:3])
    noise = force**2 * np.diag([DT**2 / 4, 1])
    for first, end in ((0, 4), (4, 7)):
        for row in range(first, end):
            mean, cov = x[row], np.diag([sensor**2, spread])
            if row > first:
                mean, cov = by_least_squares(x[first:row], u[first:row, 0], x[row, 0], sensor, force, spread)
            variance = (A @ cov @ A.T + noise)[0, 0] + sensor**2
            apart = x[row, 0] + y[row, 0] - (A @ mean + B * u[row, 0])[0]
            v = DEGREES_OF_FREEDOM
            expected = np.log(variance) / 2 + (v + 1) / 2 * np.log1p(apart**2 / variance / v)
            np.testing.assert_allclose(found[row], expected, rtol=1e-6)


def test_positions_that_are_measured_together_are_measured_one_after_the_other(x64):
    """A common draw of several innovations has the density that the whole covariance gives it."""
    draw = np.random.default_rng(3)
    slopes, std = 0.3 * draw.normal(size=(4, 4)), jnp.array([0.1, 0.4, 0.3, 0.2])
    x, y, spread = draw.normal(size=(1, 4)), draw.normal(size=(1, 4)), np.array([0.5, 0.8])
    predict = lambda x, u: Prediction(slopes @ x, std)  # noqa: E731
    rows = Batch(*map(jnp.asarray, (x, np.zeros((1, 1)), y)))
    found = filtered(predict, rows, jnp.array([True]), jnp.asarray(spread), rates=(1, 3), angles=(), dt=DT)
    start = np.diag([std[0] ** 2 / 2, spread[0], std[2] ** 2 / 2, spread[1]])
    moved = np.diag([(DT / 2 * std[1]) ** 2, std[1] ** 2, (DT / 2 * std[3]) ** 2, std[3] ** 2])
    onward = np.eye(4) + slopes
    cov = (onward @ start @ onward.T + moved)[::2, ::2] + np.diag(std[::2] ** 2 / 2)
    apart = (y - slopes @ x[0])[0, ::2]
    v, far = DEGREES_OF_FREEDOM, apart @ np.linalg.solve(cov, apart)
    nats = np.linalg.slogdet(cov)[1] / 2 + (v + 2) / 2 * np.log1p(far / v)
    np.testing.assert_allclose(found.nats[0], nats, rtol=1e-9)
    np.testing.assert_allclose(found.error[0], apart, rtol=1e-9)
    np.testing.assert_allclose(found.variance[0], np.diag(cov), rtol=1e-9)


def test_an_angle_that_crosses_half_a_turn_has_not_jumped(x64):
    """The data have it near pi in one row and near -pi in the next."""
    data = measured()
    spread = jnp.ones(1)
    turned = data._replace(x=data.x.at[:, 0].add(6.0)).x
    wrapped = data._replace(x=turned.at[:, 0].set((turned[:, 0] + np.pi) % (2 * np.pi) - np.pi))
    assert float(jnp.abs(wrapped.x - turned).max()) > 6
    one = lambda data: along(cart_of([0.04, 0.2]), data, spread, angles=(0,))  # noqa: E731
    np.testing.assert_allclose(one(wrapped), one(data), rtol=1e-9)


def test_the_true_gain_makes_positions_likeliest_where_computed_rates_mislead(x64):
    """Rates that are .5 off leave a fit of rows with another gain, or none."""
    data = measured((40,) * 25, 1000, rates=0.0)
    late = data._replace(x=data.x.at[1:, 1].set(data.y[:-1, 0] / DT))  # a difference is the rate half a period ago
    gains = np.linspace(0.5, 1.5, 41)
    nats = [float(jnp.mean(along(cart_of([0.03 * np.sqrt(2), 0.2], gain), late, jnp.ones(1)))) for gain in gains]
    assert gains[np.argmin(nats)] == pytest.approx(1, abs=0.06)
    change = np.diff(np.asarray(late.x[:, 1]))
    of_rows = np.linalg.lstsq(DT * np.asarray(late.u[:-1, :1]), change, rcond=None)[0]
    assert abs(of_rows[0] - 1) > 0.3


@pytest.mark.parametrize("seed", range(3))
def test_single_precision_leaves_no_variance_below_zero(seed):
    """Where rates are unknown at first and sensors exact, most of a variance is subtracted from itself."""
    draw = np.random.default_rng(seed)
    slopes, std = draw.normal(size=(4, 4)) * [[0.1, 0.02, 0.1, 0.02]], np.array([1e-3, 0.3, 1e-3, 0.3])
    x, y = draw.normal(size=(400, WINDOW, 4)), draw.normal(size=(400, WINDOW, 4))

    def of(kind):
        predict = lambda x, u: Prediction(jnp.asarray(slopes, kind) @ x, jnp.asarray(std, kind))  # noqa: E731
        given = [jnp.asarray(rows, kind) for rows in (x, np.zeros((400, WINDOW, 1)), y)]
        variance, begins = jnp.full(2, 100, kind), jnp.zeros(WINDOW, bool)
        along = partial(filtered, predict, rates=(1, 3), angles=(), dt=0.02)
        return jax.jit(jax.vmap(lambda *rows: along(Batch(*rows), begins, variance).nats))(*given)

    single = of(np.float32)
    with jax.enable_x64(True):
        np.testing.assert_allclose(single, of(np.float64), rtol=0.02)


def test_windows_draw_every_row_as_often_and_in_order():
    data = Dataset(jnp.arange(64.0)[:, None], jnp.zeros((64, 1)), jnp.zeros((64, 1)), jnp.int32(60))
    x = np.asarray(windows(jax.random.key(0), data, 20_000).x)
    assert x.shape == (800, WINDOW, 1)
    assert set(np.unique(np.diff(x[..., 0]))) == {1, -59}
    counts = np.bincount(x.astype(int).ravel(), minlength=60)
    assert counts.shape == (60,)
    assert counts.std() < 0.1 * counts.mean()
    assert windows(jax.random.key(0), data, 1).x.shape == (1, WINDOW, 1)
    few = windows(jax.random.key(0), data._replace(size=jnp.int32(3)), WINDOW)
    assert set(np.asarray(few.x).ravel()) == {0, 1, 2}


MEMBERS = {
    "network": bnn(states=2, controls=1, angles=(), hidden=(8,), heteroscedastic=True, dropout=binary()),
    "mechanism": lagrangian(
        states=2,
        controls=1,
        angles=(),
        rates=(1,),
        dt=DT,
        substeps=1,
        hidden=(8,),
        activation="silu",
        dropout=binary(),
    ),
}


@pytest.mark.parametrize("name", MEMBERS)
def test_the_penalty_is_what_a_loss_has_beside_the_likelihood(name, x64):
    """It is divided by the number of rows, with positions and without."""
    data, model = measured((20,), 20), MEMBERS[name]
    params = model.init(jax.random.key(0))
    penalty = float(model.penalty(params))
    assert penalty > 0
    batch, context = Batch(data.x, data.u[:, :1], data.y), model.prepare(data._replace(u=data.u[:, :1]))
    more, less = (model.loss(params, jax.random.key(2), batch, context._replace(size=size)) for size in (10.0, 20.0))
    np.testing.assert_allclose(more - less, penalty / 20, rtol=1e-6)
    whole, bare = (
        innovations(one, rates=(1,), angles=(), inputs=1, dt=DT) for one in (model, model._replace(penalty=lambda _: 0))
    )
    more, less = (one.loss(params, jax.random.key(2), batch, one.prepare(data)) for one in (whole, bare))
    np.testing.assert_allclose(more - less, penalty / 20, rtol=1e-6)


def test_a_networks_positions_follow_its_rates(x64):
    """By their mean over the period; noise, and the change of the rates, are the network's own."""
    model = MEMBERS["network"]
    posterior = model.posterior(model.init(jax.random.key(0)), measured()._replace(u=measured().u[:, :1]))
    draw, x, u = model.sample(jax.random.key(1), posterior), jnp.array([3.0, -2.0]), jnp.array([0.5])
    plain, found = (one.apply(posterior, draw, x, u) for one in (model, integrated(model, rates=(1,), dt=DT)))
    np.testing.assert_array_equal(found.std, plain.std)
    np.testing.assert_allclose(found.mean, [DT * (-2 + plain.mean[1] / 2), plain.mean[1]], rtol=1e-12)


def test_a_model_that_does_not_say_its_penalty_is_refused():
    with pytest.raises(ValueError, match="the model has no penalty"):
        innovations(MEMBERS["network"]._replace(penalty=None), rates=(1,), angles=(), inputs=1, dt=DT)


@pytest.mark.parametrize("model", [BNN(hidden=(20,), ensemble_size=2), Lagrangian(hidden=(20,), ensemble_size=1)])
def test_a_fit_to_positions_finds_what_a_force_does(model):
    """Through the whole experiment: the change of the rate by the control, of rates that were never measured.

    Its errors in the next episode are those of positions, through the filter.
    """
    sensors = Sensors(measured=(0,), velocity="difference")
    config = replace(tiny(trials=8, sensors=sensors, explore__trials=8), model=model)
    exp = compose(config, cart(25))
    state = exp.init(jax.random.key(0))
    for _ in range(8):
        state = jax.jit(lambda state: exp.add_episode(state, exp.collect(state)))(state)
    state, info = jax.jit(exp.fit)(state)
    assert info.skipped == 0
    assert info.loss < info.first
    posterior = exp.dynamics.posterior(state.model.params, state.data)
    draws = jax.vmap(exp.dynamics.sample, (0, None))(jax.random.split(jax.random.key(1), 20), posterior)

    def change(u):
        of_draw = lambda draw: exp.dynamics.apply(posterior, draw, jnp.zeros(2), jnp.array([u])).mean[1]  # noqa: E731
        return float(jnp.mean(jax.vmap(of_draw)(draws)))

    assert (change(1.0) - change(-1.0)) / 2 == pytest.approx(0.3, rel=0.15)

    ran = exp.collect(state)
    (x, _), m = exp.task.hindsight.states(ran.x, 25, ran.u), recall.replay(exp.task.memory, ran)
    seen = ran._replace(x=x, u=jax.vmap(recall.steps(exp.task.memory)[1])(m[:-1], ran.u))
    ask = partial(calibration, trial_key(state.key, state.trial + 1, CALIBRATE), posterior, seen)
    by_filter = partial(filtered_errors, rates=(1,), dt=exp.task.dt)
    of_positions = ask(dynamics=exp.dynamics, angles=(), errors=by_filter)
    assert float(exp.calibrate(state, ran)) == pytest.approx(float(of_positions), rel=1e-3)
