"""Devices as one: which are a mesh, and where our own kernels may compute."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from pegasus_jax import sharding


@pytest.fixture
def two_gpus(monkeypatch: pytest.MonkeyPatch) -> None:
    """This CPU, taken for the first of two GPUs."""
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    monkeypatch.setattr(jax, "device_count", lambda: 2)


def test_one_device_is_a_mesh_where_there_are_several(two_gpus: None, monkeypatch: pytest.MonkeyPatch) -> None:
    one = sharding.mesh(1, 1)
    assert one is not None
    assert dict(one.shape) == {sharding.SEEDS: 1, sharding.PARTICLES: 1}
    monkeypatch.setattr(jax, "process_count", lambda: 2)  # the others have no device of that mesh
    assert sharding.mesh(1, 1) is None


def test_the_only_device_is_no_mesh() -> None:
    assert jax.device_count() == 1
    assert sharding.mesh(1, 1) is None
    with pytest.raises(ValueError, match="needs 2 devices and there is 1"):
        sharding.mesh(2, 1)


def test_kernels_stay_where_every_device_runs_its_own_seeds(two_gpus: None) -> None:
    seen = []

    def double(x: jax.Array, factor: jax.Array) -> jax.Array:
        seen.append(sharding.pallas_allowed(x))
        return factor * x

    x, one = jnp.arange(3.0), sharding.mesh(1, 1)
    assert one is not None
    jax.eval_shape(double, x, 2.0)
    given = sharding.each_its_own(double, one, (0, None), 0)(x, jnp.float32(2))
    np.testing.assert_array_equal(given, 2 * np.arange(3))
    assert seen == [False, True], "the compiler may have split what is given to plain jit"


def test_kernels_are_for_single_precision_on_a_gpu(monkeypatch: pytest.MonkeyPatch) -> None:
    assert not sharding.pallas_allowed(jnp.zeros(2, jnp.float32)), "a processor"
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    assert sharding.pallas_allowed(jnp.zeros(2, jnp.float32))
    assert not sharding.pallas_allowed(jnp.zeros(2, jnp.float16))
