"""A plant, a dynamics model and an optimizer of your own, in a program that you compile yourself.

    python own_model_in_jit.py [trials=4] [fit=300] [search=300]

The model is Bayesian linear regression: what is known of its weights after some data is a Gaussian in closed form, one
draw of them is one function of state and control, and only the size of the noise is left to fit.
"""

import sys
from dataclasses import replace
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import optax

import pegasus_jax as pg

CART = SimpleNamespace(  # state and observation: position [m] and velocity [m/s]; control: force [N]
    reset=lambda key: jnp.array([1.0, 0.0]) + 0.05 * jax.random.normal(key, (2,)),
    step=lambda x, u: x + 0.1 * jnp.stack([x[1], 2.0 * u[0] - 0.3 * x[1]]),
    observe=lambda x: x,
)
STATES = dict(state_names=("x", "v"), angles=(), start_mean=[1, 0], start_std=[0.05, 0.05], sensor_std=[0.01, 0.01])
CONTROLS = dict(control_names=("force",), control_low=[-2], control_high=[2], horizon=30, dt=0.1)
TASK = pg.Task("cart", CART, lambda x: 1 - jnp.exp(-jnp.sum(x**2) / (2 * 0.3**2)), **STATES, **CONTROLS)


def regression(states: int) -> pg.Dynamics:
    """Change of state [D] = weights [D, D + U] @ (state, control) + noise; the prior of each weight is N(0, 1)."""

    def weights(params, data):
        """Mean [D, D + U] of the weights, and a root [D, D + U, D + U] of their covariance."""
        rows = jnp.concatenate([data.x, data.u], 1)  # those not in use yet are zero, and say nothing

        def of_one(precision, target):
            root = jnp.linalg.inv(jnp.linalg.cholesky(precision * rows.T @ rows + jnp.eye(rows.shape[1]))).T
            return precision * root @ root.T @ rows.T @ target, root

        return jax.vmap(of_one, (0, 1))(jnp.exp(-2 * params), data.y)

    def loss(params, key, batch, data):
        """-log evidence a row [nats] of all the data, but for a constant; `batch` is not needed."""
        mean, root = weights(params, data)
        wrong = jnp.sum((data.y - jnp.concatenate([data.x, data.u], 1) @ mean.T) ** 2, 0) * jnp.exp(-2 * params)
        volume = jnp.sum(jnp.log(jnp.diagonal(root, axis1=1, axis2=2)), 1)
        return jnp.sum(wrong / 2 + jnp.sum(mean**2, 1) / 2 - volume + data.size * params) / data.size

    return pg.Dynamics(
        init=lambda key: jnp.full(states, -2.0),  # log of the noise's deviation
        prepare=lambda data: data,
        loss=loss,
        posterior=lambda params, data: (params, *weights(params, data)),
        sample=lambda key, known: known[1] + jnp.einsum("dij,dj->di", known[2], jax.random.normal(key, known[1].shape)),
        apply=lambda known, draw, x, u: pg.Prediction(draw @ jnp.concatenate([x, u]), jnp.exp(known[0])),
    )


def main(words: list[str]) -> None:
    asked = {"trials": 4, "fit": 300, "search": 300} | {key: int(n) for key, n in (word.split("=") for word in words)}
    config = pg.preset("mjcf")  # what a plant of your own begins with
    fit, search = replace(config.fit, steps=asked["fit"]), replace(config.search, steps=asked["search"])
    config = replace(config, trials=asked["trials"], policy=pg.config.MLP(hidden=(20,)), fit=fit, search=search)
    dynamics = regression(states=2)
    fitter = pg.minibatches(dynamics, optax.chain(optax.clip_by_global_norm(10.0), optax.nadam(0.03)), batch_size=1)
    experiment = pg.compose(config, TASK, dynamics=dynamics, fitter=fitter)

    def trial(state, _):
        trajectory = experiment.collect(state)
        surprise = experiment.calibrate(state, trajectory)  # NaN before the model knows anything
        state, _ = experiment.improve(experiment.add_episode(state, trajectory))
        return state, (trajectory.cost.mean(), surprise)

    learn = jax.jit(lambda key: jax.lax.scan(trial, experiment.init(key), None, config.trials))
    for number, (cost, surprise) in enumerate(zip(*learn(jax.random.key(0))[1], strict=True), 1):
        print(f"trial {number}: mean cost {cost:.3f}, errors {surprise:.2f} times as large as expected")


main(sys.argv[1:])
