"""The mechanism's GPU kernel, interpreted and on a GPU, against the plain form. And that it compiles."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.sharding import AbstractDevice, AbstractMesh, use_abstract_mesh

from pegasus_jax.models import _lagrangian_pallas as kernel
from pegasus_jax.models import dropout
from pegasus_jax.models.lagrangian import lagrangian
from pegasus_jax.types import Array, Dataset
from pegasus_jax.vectorized import for_particles

# x in the order of a user's, with angles and rates anywhere; widths that are no powers of two are filled up.
DOUBLE = dict(states=6, controls=1, angles=(4, 5), rates=(1, 2, 3), hidden=(32, 32), activation="silu")
SINGLE = dict(states=4, controls=2, angles=(3,), rates=(2, 1), hidden=(20, 17, 5), activation="tanh")
RELU = dict(states=2, controls=1, angles=(), rates=(1,), hidden=(16,), activation="relu")
K = 21  # no whole number of blocks


def pieces(case: dict, noise: dropout.Dropout, substeps: int) -> tuple:
    """(plain, fused, posterior, masks, x, u) of random data in single precision."""
    model = lagrangian(**case, dropout=noise, dt=0.1, substeps=substeps)
    d, c = case["states"], case["controls"]
    random = np.random.default_rng(0)
    x, u, y = (jnp.asarray(random.normal(size=(50, n)), jnp.float32) for n in (d, c, d))
    params = jax.tree.map(lambda leaf: leaf.astype(jnp.float32), model.init(jax.random.key(1)))
    params["constant"], params["resistance"] = (jnp.full_like(params[name], 0.3) for name in ("constant", "resistance"))
    posterior = model.posterior(params, Dataset(3.0 * x, u, y, jnp.int32(50)))
    masks = jax.vmap(lambda key: model.sample(key, posterior))(jax.random.split(jax.random.key(2), K))
    masks = jax.tree.map(lambda leaf: leaf.astype(jnp.float32), masks)
    each = jax.vmap(model.apply, (None, 0, 0, 0))
    order = np.array([*(i for i in range(d) if i not in case["rates"]), *case["rates"]])
    coordinates = order[: d // 2]
    turning = tuple(i for i, coordinate in enumerate(coordinates) if coordinate in case["angles"])

    def plain(*arguments: Array) -> Array:
        return each(*arguments).mean

    mechanics = dict(turning=turning, dt=0.1, substeps=substeps, activation=case["activation"])
    fused = {on: kernel.fused(plain, order, **mechanics, interpret=on) for on in (True, False)}
    return plain, fused, posterior, masks, 2.0 * x[:K], u[:K]


CASES = [
    pytest.param(DOUBLE, dropout.log_normal(-10.0, 0.0), 2, id="two poles", marks=pytest.mark.slow),
    pytest.param(SINGLE, dropout.none(), 1, id="one pole, two controls", marks=pytest.mark.campaign),
    pytest.param(RELU, dropout.binary(0.1), 3, id="no pole"),
]


@pytest.mark.parametrize("interpret", [True, pytest.param(False, marks=pytest.mark.gpu)])
@pytest.mark.parametrize(("case", "noise", "substeps"), CASES)
def test_as_the_plain_form(case: dict, noise: dropout.Dropout, substeps: int, interpret: bool) -> None:
    plain, fused, *arguments = pieces(case, noise, substeps)
    weight = jax.random.normal(jax.random.key(3), (K, case["states"]))

    by = (0, 1, 2, 3) if case is RELU else (2, 3)  # by posterior and masks it is the plain form's: once is enough

    def both(change: Callable) -> tuple:
        value = lambda *given: jnp.sum(weight * change(*given))  # noqa: E731
        return jax.jit(change)(*arguments), jax.jit(jax.grad(value, by, allow_int=True))(*arguments)

    with jax.default_matmul_precision("float32"):  # as in a run: a GPU's products are less exact by default
        expected, gradients = both(plain)
    got, ours = both(fused[interpret])
    np.testing.assert_allclose(got, expected, rtol=2e-5, atol=2e-5)
    for mine, theirs in zip(jax.tree.leaves(ours), jax.tree.leaves(gradients), strict=True):
        if mine.dtype == jnp.float32:
            np.testing.assert_allclose(mine, theirs, rtol=2e-4, atol=2e-5 * (1 + float(jnp.max(jnp.abs(theirs)))))


def test_a_model_takes_it_where_there_is_one_gpu(monkeypatch: pytest.MonkeyPatch) -> None:
    _, _, posterior, masks, x, u = pieces(RELU, dropout.none(), 1)
    model = lagrangian(**RELU, dropout=dropout.none(), dt=0.1, substeps=1)
    expected, calls = jax.vmap(model.apply, (None, 0, 0, 0))(posterior, masks, x, u), []

    def fused(*arguments: object, **mechanics: object) -> object:
        calls.append(mechanics)
        return interpreted(*arguments, **mechanics, interpret=True)

    interpreted = kernel.fused
    monkeypatch.setattr(kernel, "fused", fused)
    for there in (False, True):
        monkeypatch.setattr("pegasus_jax.models.lagrangian.pallas_allowed", lambda x, there=there: there)
        got = for_particles(model.apply)(posterior, masks, x, u)
        np.testing.assert_allclose(got.mean, expected.mean, rtol=2e-5, atol=2e-5)
        np.testing.assert_allclose(got.std, expected.std, rtol=1e-6)
        assert len(calls) == there
    own = model._replace(apply=lambda posterior, masks, x, u: u)  # a model that somebody changed
    np.testing.assert_array_equal(for_particles(own.apply)(posterior, masks, x, u), u)


@pytest.mark.parametrize(("case", "noise", "substeps"), CASES)
def test_compiles_for_a_gpu_that_is_not_there(case: dict, noise: dropout.Dropout, substeps: int) -> None:
    """Down to the kernel compiler's own language, with seeds and policies as further axes."""
    _, fused, posterior, masks, x, u = pieces(case, noise, substeps)

    def slope(posterior: object, masks: object, x: Array) -> Array:
        return jax.grad(lambda x: jnp.sum(fused[False](posterior, masks, x, u)))(x)

    seeds = jax.tree.map(lambda leaf: jnp.stack([leaf] * 2), (posterior, masks, jnp.stack([x] * 3)))
    policies = jax.vmap(slope, (None, None, 0))
    there = AbstractMesh((), (), abstract_device=AbstractDevice("NVIDIA H200", num_cores=None, platform="cuda"))
    with use_abstract_mesh(there):
        text = jax.jit(jax.vmap(policies)).trace(*seeds).lower(lowering_platforms=("cuda",)).as_text()
    assert text.count("@__gpu$xla.gpu.triton") == 2, "there and back"


def test_it_is_for_small_mechanisms() -> None:
    assert kernel.suits((32, 32), 3)
    assert not kernel.suits((200, 200), 3)
    assert not kernel.suits((), 3)
    assert not kernel.suits((32,), 7)
