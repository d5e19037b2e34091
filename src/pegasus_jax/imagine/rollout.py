"""K imagined trajectories as a deterministic function of policy, posterior and scenarios. No keys here."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from pegasus_jax import memory as recall
from pegasus_jax.shapes import check_params, check_prediction, check_scenarios, check_shape
from pegasus_jax.types import Array, Dynamics, Params, Policy, Rollout, Scenarios
from pegasus_jax.vectorized import for_particles

# Platform -> steps of the time loop compiled as one. Each round of a loop costs a GPU copies and launches
# (docs/decisions.md 0013), and more steps than these take it longer to compile; a CPU would only compile longer.
UNROLL = {"gpu": 5}


class NoiseUse(NamedTuple):
    """Where observation noise enters a rollout, as factors of the model's predicted std (docs/reference.md 5.4)."""

    policy: float = 1.0  # the policy sees x_t + factor * std_t * noise_t
    state: float = 0.0  # the state itself moves by factor * std * noise
    sensors: Any = None  # [D] the std of what the policy sees, where it is known; None: as predicted


def rollout(
    policy_params: Params,
    posterior: Params,
    scenarios: Scenarios,
    *,
    dynamics: Dynamics,
    policy: Policy,
    match: Callable[[Array, Array], Array],
    noise: NoiseUse = NoiseUse(),
    limit: Array | float | None = None,
) -> Rollout:
    """Roll K particles out for H steps (Alg. 3 lines 6 to 14): states [H + 1, K, D], controls [H, K, U].

    Each particle keeps one draw of the model and one of the policy along its whole trajectory. `match`,
    such as `matching.match` or `matching.keep`, makes the particles of the next step of x [K, D] and of z [K, D] from
    the standard normal distribution. No gradient flows through the predicted noise. With a `limit`, a particle's
    gradient is dropped at a state where it is longer than that (`limited`). The policy's memory holds what it observed,
    noise included.

    Raises ValueError, while it is traced, where shapes do not agree; the message names the argument.
    """
    check_params("policy_params", policy_params)
    check_scenarios(scenarios, len(policy.memory.names))
    act = jax.vmap(policy.apply, (None, 0, 0))
    predict = for_particles(dynamics.apply)
    see, given, advance = (jax.vmap(function) for function in recall.steps(policy.memory))
    start, states = scenarios.start, scenarios.sensor.shape[-1]

    def step(carry: tuple[Array, Array], draws: tuple[Array, ...]) -> tuple[tuple[Array, Array], tuple]:
        state, obs_noise = carry
        sensor, redraw = draws
        if limit is not None:
            state = limited(state, limit)
        x, m = recall.split(state, states)
        o = x + noise.policy * obs_noise
        u = act(policy_params, scenarios.policy, see(m, o))
        check_shape("what policy.apply returns for K particles", u, (len(x), None), "[K, U]")
        change = predict(posterior, scenarios.dynamics, x, given(m, u))
        check_prediction("dynamics.apply returns for K particles", change, x.shape, "[K, D]")
        std = jax.lax.stop_gradient(change.std)
        drawn = std * sensor
        after = match(recall.join(x + change.mean + noise.state * drawn, advance(m, o, u)), redraw)
        obs_noise = drawn if noise.sensors is None else noise.sensors * sensor
        return (after, obs_noise), (after, u, std)

    draws = (scenarios.sensor, scenarios.match)
    unroll = UNROLL.get(jax.default_backend(), 1)
    begun = start, jnp.zeros_like(start[:, :states])
    _, (x, u, std) = jax.lax.scan(step, begun, draws, unroll=unroll)
    return Rollout(jnp.concatenate([start[None], x]), u, std)


def limited(x: Array, limit: Array | float) -> Array:
    """x [K, D] itself; a row's gradient is dropped where it is longer than `limit`, [] or [D], or not finite.

    On a chaotic plant the gradient of one particle can be 1e9 times that of the others. In their sum it would drown
    them, and clipped it would keep a random direction. Where it is dropped, the controls before that state answer only
    for the costs up to it.
    """

    def backward(limit: Array, gradient: Array) -> tuple[Array, Array]:
        square = jnp.sum((gradient / limit) ** 2, -1, keepdims=True)
        return jnp.where(square <= 1, gradient, 0.0), jnp.zeros_like(limit)  # NaN is not

    same = jax.custom_vjp(lambda x, limit: x)
    same.defvjp(lambda x, limit: (x, limit), backward)
    return same(x, jnp.asarray(limit, x.dtype))  # type: ignore[return-value]
