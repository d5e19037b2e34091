"""PILCO's search: the expected cost of a Gaussian state propagated through policy and model, minimized by L-BFGS.

Deisenroth & Rasmussen 2011; Deisenroth 2010, ch. 3. The objective is a deterministic function of policy parameters and
posterior: neither keys nor scenarios.
"""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import optax

from pegasus_jax.imagine import costs
from pegasus_jax.imagine.rollout import NoiseUse
from pegasus_jax.learn.gradient import SearchInfo
from pegasus_jax.math.gaussian import Image, chain, joint, residual, sincos
from pegasus_jax.pilco import lbfgs
from pegasus_jax.types import Array, Cost, Dynamics, Key, Params, Policy, PolicyOptimizer, TrainState


class Gaussians(NamedTuple):
    """The distribution of the state at the steps 0..H."""

    mean: Array  # [H+1, D]
    cov: Array  # [H+1, D, D]


def step(
    mean: Array,
    cov: Array,
    blur: Array,
    policy_params: Params,
    posterior: Params,
    *,
    dynamics: Dynamics,
    policy: Policy,
    angles: tuple[int, ...],
) -> Image:
    """Moments of the next state, x + change(features(x), u), for a Gaussian state x with mean [D] and cov [D, D].

    The policy sees x with independent noise of variance `blur` [D]; that noise widens the control, and so the next
    state, but the covariance of control and state is that of the state alone.
    """
    assert policy.moments is not None
    assert dynamics.moments is not None
    seen = sincos(mean, cov + jnp.diag(blur), angles)
    control = policy.moments(policy_params, seen.mean, seen.cov)
    change = chain(partial(sincos, angles=angles), joint(lambda *_: control), partial(dynamics.moments, posterior))
    return residual(change)(mean, cov)


def propagate(
    policy_params: Params,
    posterior: Params,
    start: tuple[Array, Array],
    std: Array,
    *,
    horizon: int,
    noise: NoiseUse = NoiseUse(),
    dynamics: Dynamics,
    policy: Policy,
    angles: tuple[int, ...],
) -> Gaussians:
    """H steps from the Gaussian `start` (mean [D], cov [D, D]); dynamics and policy must have `moments`.

    `std` [D] is that of the model's observation noise, which enters as in a rollout of particles: on what the policy
    sees from the second step on, and, by the factor `noise.state`, on the state itself: independently, where a particle
    has one draw for both. The original has neither; the authors' sparse-spectrum model adds its noise to the state (its
    factor is 1, the policy's 0).
    """
    one = partial(step, dynamics=dynamics, policy=policy, angles=angles)
    variance = jax.lax.stop_gradient(std) ** 2

    def advance(carry: tuple[Array, Array, Array], _: None) -> tuple[tuple[Array, Array, Array], Gaussians]:
        image = one(*carry, policy_params, posterior)
        mean, cov = image.mean, image.cov + noise.state**2 * jnp.diag(variance)
        return (mean, cov, noise.policy**2 * variance), Gaussians(mean, cov)

    mean, cov = start
    carry = (mean, cov, jnp.zeros_like(mean))
    # Recomputed on the way back: the matrices of a step, [n, n] for every pair of outputs, would fill the memory.
    _, later = jax.lax.scan(jax.checkpoint(advance, prevent_cse=False), carry, None, horizon)
    return Gaussians(*(jnp.concatenate([jnp.asarray(a)[None], b]) for a, b in zip(start, later, strict=True)))


def objective(
    policy_params: Params,
    posterior: Params,
    start: tuple[Array, Array],
    std: Array,
    *,
    horizon: int,
    dynamics: Dynamics,
    policy: Policy,
    angles: tuple[int, ...],
    cost: Cost,
    aggregate: Callable[[Array], Array] = costs.mean,
    noise: NoiseUse = NoiseUse(),
) -> Array:
    """J(theta): the expected cost of the steps 1..H, [H, 1], made one number by `aggregate`."""
    pieces: dict[str, Any] = dict(dynamics=dynamics, policy=policy, angles=angles)
    states = propagate(policy_params, posterior, start, std, horizon=horizon, noise=noise, **pieces)
    return aggregate(jax.vmap(costs.expectation(cost))(states.mean[1:], states.cov[1:])[:, None])


def analytic(
    objective: Callable[[Params, Params, Array], Array],
    noise_std: Callable[[Key, Params], Array],
    restart: bool = False,
) -> PolicyOptimizer:
    """The searcher that minimizes `objective(policy parameters, posterior, std)` by L-BFGS, as far as that goes.

    `noise_std(key, posterior)` is the model's noise std [D]. With `restart` a search starts from its fresh policy where
    that costs no more than the one before. No search uses values or the curvature of an earlier one: those were of
    another model.
    """

    def run(
        key: Key,
        learner: TrainState,
        posterior: Params,
        *,
        first: Array | int,
        steps: int,
        fresh: Params | None = None,
        **_: Any,
    ) -> tuple[TrainState, SearchInfo]:
        std = noise_std(key, posterior)

        def value(params: Params) -> Array:
            return objective(params, posterior, std)

        def cheaper(params: Params) -> Params:
            """These, or the fresh ones where those cost no more."""
            one = jax.tree.map(lambda leaf: leaf[0], fresh)
            own, other = jax.vmap(value)(jax.tree.map(lambda *leaves: jnp.stack(leaves), params, one))
            return optax.tree.where((other <= own) | jnp.isnan(own) & ~jnp.isnan(other), one, params)

        new = jnp.asarray(first) == 0
        if restart:
            learner = learner._replace(params=jax.lax.cond(new, cheaper, lambda params: params, learner.params))

        def idle(d: lbfgs.Descent) -> tuple[lbfgs.Descent, tuple[Array, Params]]:
            return d, (d.value, optax.tree.get(d.state, "grad"))

        def iterate(d: lbfgs.Descent, _: None) -> tuple[lbfgs.Descent, tuple[Array, Array]]:
            d, (cost, gradient) = jax.lax.cond(d.failures < 2, partial(lbfgs.step, value), idle, d)
            return d, (cost, optax.tree.norm(gradient))

        descent = optax.tree.where(new, lbfgs.begin(learner.params), learner.optimizer)
        after, (values, norms) = jax.lax.scan(iterate, descent, None, steps)
        return TrainState(after.params, after), SearchInfo(values, norms, after.skipped - descent.skipped)

    return PolicyOptimizer(lbfgs.begin, run)
