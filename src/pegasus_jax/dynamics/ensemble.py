"""Several models fitted side by side, of which each particle follows one (Lakshminarayanan 2017; PETS, Chua 2018)."""

import jax
import jax.numpy as jnp

from pegasus_jax.types import Array, Batch, Dataset, Dynamics, Key, Params, Prediction


def ensemble(member: Dynamics, members: int) -> Dynamics:
    """`members` models of one kind as one distribution over functions.

    They differ by their initial parameters and by their minibatches: each draws its own rows, with replacement, from
    the batch it is given. A particle follows one member, drawn uniformly, and one draw of that member, along its whole
    trajectory (PETS' TS-infinity).

    Every member predicts for every particle and all but one answer is dropped: `members` times the arithmetic, but in
    the large matrix products that processors like. Giving each particle its own copy of the weights costs more.
    """

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

    def condition(params: Params, data: Dataset) -> Params:
        return jax.vmap(member.condition, (0, None))(params, data)

    def sample(key: Key, belief: Params) -> tuple[Array, Params]:
        chosen, own = jax.random.split(key)
        index = jax.random.randint(chosen, (), 0, members)
        return jax.nn.one_hot(index, members), member.sample(own, jax.tree.map(lambda leaf: leaf[index], belief))

    def apply(belief: Params, draw: tuple[Array, Params], x: Array, u: Array) -> Prediction:
        chosen, own = draw
        mean, std = jax.vmap(member.apply, (0, None, None, None))(belief, own, x, u)
        return Prediction(chosen @ mean, chosen @ std)

    return Dynamics(init, member.prepare, loss, condition, sample, apply)
