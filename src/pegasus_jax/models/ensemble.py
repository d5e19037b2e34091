"""Several models fitted side by side, of which each particle follows one (Lakshminarayanan 2017; PETS, Chua 2018)."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from pegasus_jax.checks import check_range
from pegasus_jax.types import Array, Batch, Dataset, Dynamics, Key, Params, Prediction
from pegasus_jax.vectorized import Vectorized


class Dealt(NamedTuple):
    """Draws of K particles: the k-th particle follows member k modulo `members`."""

    chosen: Array  # [K, members], 1 where a particle follows that member
    own: Params  # [K, ...] its draw of that member


def ensemble(member: Dynamics, members: int) -> Dynamics:
    """`members` models of one kind as one distribution over functions of (x [D], u [U]).

    They differ by their initial parameters and by their minibatches: each draws its own rows, with replacement, from
    the batch it is given. A particle follows one member, and one draw of that member, along its whole trajectory
    (PETS' TS-infinity).

    A function alone follows a member drawn uniformly. The K functions of a rollout are dealt to the members in turn, so
    that each predicts for its own particles only, with the arithmetic of one model. Where that is not known, every
    member predicts for every particle and all but one answer is dropped; a copy of the weights each would cost more.
    Raises ConfigError for no members.
    """
    check_range("members", members, 1)

    def init(key: Key) -> Params:
        return jax.vmap(member.init)(jax.random.split(key, members))

    def loss(params: Params, key: Key, batch: Batch, context: Params) -> Array:
        rows = batch.x.shape[0]

        def one(params: Params, key: Key) -> Array:
            row_key, noise_key = jax.random.split(key)
            index = jax.random.randint(row_key, (rows,), 0, rows)
            return member.loss(params, noise_key, Batch(*(column[index] for column in batch)), context)

        # The sum, so that each member's gradient is what it would be alone.
        return jnp.sum(jax.vmap(one)(params, jax.random.split(key, members)))

    def posterior(params: Params, data: Dataset) -> Params:
        return jax.vmap(member.posterior, (0, None))(params, data)

    def follow(index: Array, key: Key, posterior: Params) -> tuple[Array, Params]:
        return jax.nn.one_hot(index, members), member.sample(key, jax.tree.map(lambda leaf: leaf[index], posterior))

    def sample(key: Key, posterior: Params) -> tuple[Array, Params]:
        chosen, own = jax.random.split(key)
        return follow(jax.random.randint(chosen, (), 0, members), own, posterior)

    def deal(keys: Key, posterior: Params) -> Dealt:
        return Dealt(*jax.vmap(follow, (0, 0, None))(jnp.arange(len(keys)) % members, keys, posterior))

    def apply(posterior: Params, draw: tuple[Array, Params], x: Array, u: Array) -> Prediction:
        chosen, own = draw
        mean, std = jax.vmap(member.apply, (0, None, None, None))(posterior, own, x, u)
        return Prediction(chosen @ mean, chosen @ std)

    def together(posterior: Params, draws: Any, x: Array, u: Array) -> Prediction:
        if not isinstance(draws, Dealt):
            return jax.vmap(apply, (None, 0, 0, 0))(posterior, draws, x, u)
        rounds = -(-len(x) // members)
        filled = jnp.arange(rounds * members) % len(x)  # the last round is filled up, and its surplus is dropped

        def split(rows: Array) -> Array:
            whole = rows if len(filled) == len(x) else rows[filled]
            return whole.reshape(rounds, members, *rows.shape[1:])

        each = jax.vmap(jax.vmap(member.apply, (None, 0, 0, 0)), (0, 1, 1, 1), 1)
        answers = each(posterior, *jax.tree.map(split, (draws.own, x, u)))
        return jax.tree.map(lambda answer: answer.reshape(-1, *answer.shape[2:])[: len(x)], answers)

    return Dynamics(init, member.prepare, loss, posterior, sample, Vectorized(apply, together), deal=deal)
