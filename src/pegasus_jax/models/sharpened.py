"""A model fitted on rates computed from positions: it takes out the error that changes of the control make."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from pegasus_jax.types import Array, Batch, Dataset, Dynamics, Key, Params


def sharpened(model: Dynamics, *, rates: tuple[int, ...], controls: int, inputs: int) -> Dynamics:
    """The model, whose data's controls [N, inputs + 2 controls] tell how far their rates are from the true ones.

    A held control bends a position suddenly, and a polynomial through the positions around cuts the corner. To first
    order its rate is then what the true one would be, had the control been larger by e [U] for a period: e is known,
    for a row's beginning and for its end, and what e does the model says itself, as it is while it is fitted.
    """
    place = np.array(rates)

    def plain(data: Dataset) -> Dataset:
        return data._replace(u=data.u[:, :inputs])

    def loss(params: Params, key: Key, batch: Batch, context: tuple[Any, Dataset]) -> Array:
        known, data = context
        draw_key, loss_key = jax.random.split(key)
        posterior = model.posterior(jax.lax.stop_gradient(params), data)
        draw = model.sample(draw_key, posterior)
        u, before, after = jnp.split(batch.u, [inputs, inputs + controls], 1)

        def error(x: Array, u: Array, e: Array) -> Array:
            push = jnp.zeros_like(u).at[:controls].set(e)
            return jax.jvp(lambda u: model.apply(posterior, draw, x, u).mean[place], (u,), (push,))[1]

        begun, ended = jax.vmap(error)(batch.x, u, before), jax.vmap(error)(batch.x + batch.y, u, after)
        x, y = batch.x.at[:, place].add(-begun), batch.y.at[:, place].add(begun - ended)
        return model.loss(params, loss_key, Batch(x, u, y), known)

    return model._replace(
        prepare=lambda data: (model.prepare(plain(data)), plain(data)),
        loss=loss,
        posterior=lambda params, data: model.posterior(params, plain(data)),
    )
