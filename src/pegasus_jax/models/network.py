"""The one network: a multilayer perceptron whose noise is an argument."""

from collections.abc import Callable, Sequence

import flax.linen as nn
import jax

from pegasus_jax.types import Array

INITIALISERS: dict[str, Callable] = {
    "glorot": nn.initializers.glorot_normal(),
    "orthogonal": nn.initializers.orthogonal(),
}


@jax.custom_jvp
def silu(x: Array) -> Array:
    """x sigmoid(x). Differentiated, it leaves one array for the way back, its slope, where jax.nn.silu leaves three."""
    return nn.silu(x)


@silu.defjvp
def _silu_jvp(primals: tuple[Array], tangents: tuple[Array]) -> tuple[Array, Array]:
    (x,), (dx,) = primals, tangents
    s = nn.sigmoid(x)
    y = x * s
    return y, (s + y * (1 - s)) * dx


ACTIVATIONS: dict[str, Callable[[Array], Array]] = {"relu": nn.relu, "silu": silu, "tanh": nn.tanh}


def _small_uniform(key: jax.Array, shape: Sequence[int], dtype: object = None) -> Array:
    return jax.random.uniform(key, shape, minval=-0.01, maxval=0.01)  # as the authors' (docs/reference.md 4.1)


class MLP(nn.Module):
    """Dense layers with a nonlinearity between them; layer i sees its input times masks[i] (None: as it is)."""

    hidden: tuple[int, ...]
    outputs: int
    initialiser: str = "glorot"
    activation: str = "relu"

    @nn.compact
    def __call__(self, x: Array, masks: Sequence[Array | None]) -> Array:
        """Outputs [..., outputs] for inputs x [..., F]; masks[i] broadcasts against layer i's input."""
        kernel_init = INITIALISERS[self.initialiser]
        for i, width in enumerate((*self.hidden, self.outputs)):
            mask = masks[i]
            x = x if mask is None else x * mask
            x = nn.Dense(width, kernel_init=kernel_init, bias_init=_small_uniform, name=f"layer_{i}")(x)
            if i < len(self.hidden):
                x = ACTIVATIONS[self.activation](x)
        return x
