"""Moment matching's GPU kernel, interpreted, against the plain form: values and gradients. And that it compiles."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.sharding import AbstractDevice, AbstractMesh, use_abstract_mesh

from pegasus_jax.assembly.experiments import build
from pegasus_jax.imagine import _matching_pallas as kernel
from pegasus_jax.imagine import matching
from pegasus_jax.runs import config_io
from pegasus_jax.types import Array


def draws(particles: int, size: int) -> tuple[Array, Array, Array]:
    """Correlated particles off the origin, draws, and a cotangent, each [K, D]."""
    noise = np.random.default_rng(particles)
    x = 3 + noise.normal(size=(particles, size)) @ (np.eye(size) + 0.3 * noise.normal(size=(size, size)))
    z, weight = noise.normal(size=(2, particles, size))
    return jnp.asarray(x, jnp.float32), jnp.asarray(z, jnp.float32), jnp.asarray(weight, jnp.float32)


def both(match: Callable, x: Array, z: Array, weight: Array) -> list[Array]:
    """What is matched, and the cotangents of x and z."""
    matched, pull = jax.vjp(match, x, z)
    return [matched, *pull(weight)]


interpreted = kernel.fused(matching.match_plain, interpret=True)


@pytest.mark.parametrize(("particles", "size"), [(100, 4), (7, 1), (32, 6), (300, 3), (40, kernel.MOST)])
def test_as_the_plain_form(particles: int, size: int) -> None:
    given = draws(particles, size)
    for ours, theirs in zip(both(interpreted, *given), both(matching.match_plain, *given), strict=True):
        np.testing.assert_allclose(ours, theirs, atol=1e-4 * float(jnp.max(jnp.abs(theirs))))


@pytest.mark.parametrize("spread", [0.0, 1e-20, 1e-12, 1e-6, 1e-3, 1.0, 1e3])
def test_as_the_plain_form_however_little_particles_spread(spread: float) -> None:
    """Pivots are floored where a dimension does not vary, and count as constants on the way back."""
    x, z, weight = draws(9, 3)
    x = spread * x * jnp.array([1.0, 2.0, 0.0])
    for ours, theirs in zip(both(interpreted, x, z, weight), both(matching.match_plain, x, z, weight), strict=True):
        np.testing.assert_allclose(ours, theirs, atol=1e-4 * float(jnp.max(jnp.abs(theirs))))


@pytest.mark.parametrize("spread", [1e-12, 1e-3, 1e3])
def test_particles_on_a_line_have_finite_gradients(spread: float) -> None:
    """Whether the second pivot is floored then is a matter of rounding, so that there is no one gradient."""
    x, z, weight = draws(9, 3)
    given = 1 + spread * x[:, :1] * jnp.array([1.0, 2.0, -3.0]), z, weight
    matched, *gradients = both(interpreted, *given)
    np.testing.assert_allclose(matched, matching.match_plain(*given[:2]), atol=2e-3 * float(jnp.max(jnp.abs(matched))))
    assert all(np.all(np.isfinite(gradient)) for gradient in gradients)


def test_matching_takes_it_where_there_is_one_gpu(monkeypatch: pytest.MonkeyPatch) -> None:
    calls = []

    def fused(plain: Callable) -> Callable:
        calls.append(plain)
        return real(plain, interpret=True)

    real = kernel.fused
    monkeypatch.setattr(kernel, "fused", fused)
    x, z, _ = draws(20, 3)
    expected = matching.match_plain(x, z)
    monkeypatch.setattr(matching, "alone_on_gpu", lambda x: True)
    np.testing.assert_allclose(matching.match(x, z), expected, atol=1e-5)
    assert len(calls) == 1
    for shape in ((20, kernel.MOST + 1), (kernel.PARTICLES + 1, 3)):
        many = jnp.ones(shape)
        assert matching.match(many, many).shape == shape
    assert len(calls) == 1, "too many dimensions, and too many particles"


# Of different sizes: JAX remembers what it has traced of one.
@pytest.mark.parametrize(("model", "particles"), [("log_normal", "10"), ("lagrangian", "11")])
def test_a_search_takes_it(model: str, particles: str, monkeypatch: pytest.MonkeyPatch) -> None:
    calls = []
    real = kernel.fused
    monkeypatch.setattr(kernel, "fused", lambda plain: calls.append(plain) or real(plain))
    monkeypatch.setattr(matching, "alone_on_gpu", lambda x: True)
    words = {"task": "cartpole", "model": model, "search.steps": "2", "search.particles": particles}
    experiment = build.__wrapped__(config_io.parse(words))
    jax.eval_shape(lambda key: experiment.search(experiment.init(key), 1), jax.random.key(0))
    assert calls


def test_compiles_for_a_gpu_that_is_not_there() -> None:
    """Down to the kernel compiler's own language, with seeds and policies as further axes."""
    x, z, _ = (jnp.stack([part] * 2) for part in draws(100, 4))
    fused = kernel.fused(matching.match_plain)
    slope = jax.grad(lambda x, z: jnp.sum(fused(x, z) ** 2))
    policies = jax.vmap(slope, (0, None))
    there = AbstractMesh((), (), abstract_device=AbstractDevice("NVIDIA H200", num_cores=None, platform="cuda"))
    with use_abstract_mesh(there):
        lowered = jax.jit(jax.vmap(policies)).trace(jnp.stack([x] * 3, 1), z).lower(lowering_platforms=("cuda",))
    assert lowered.as_text().count("@__gpu$xla.gpu.triton") == 2, "there and back"
