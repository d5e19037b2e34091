"""An ensemble: members are what they would be alone, and each particle follows one of them."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from pegasus_jax.build import dynamics_of
from pegasus_jax.config import BNN
from pegasus_jax.dynamics.ensemble import ensemble
from pegasus_jax.types import Batch, Dataset
from probes import cart

MEMBERS = 3


@pytest.fixture(scope="module")
def pair():
    """A member and an ensemble of it; its parameters."""
    member = dynamics_of(BNN(hidden=(8,), dropout="none"), cart())
    many = ensemble(member, MEMBERS)
    return member, many, many.init(jax.random.key(0))


def rows(size=40):
    x, u, y = (jax.random.normal(jax.random.key(i), (size, width)) for i, width in enumerate((2, 1, 2)))
    return Dataset(x, u, y, jnp.int32(size))


def part(tree, index):
    return jax.tree.map(lambda leaf: leaf[index], tree)


def test_a_particle_follows_one_member(pair):
    member, many, params = pair
    data = rows()
    belief = many.condition(params, data)
    x, u = jnp.array([0.3, -0.2]), jnp.array([0.5])
    alone = []
    for index in range(MEMBERS):
        own = member.condition(part(params, index), data)
        alone.append(member.apply(own, member.sample(jax.random.key(9), own), x, u).mean)
    followed = set()
    for seed in range(12):
        draw = many.sample(jax.random.key(seed), belief)
        predicted = many.apply(belief, draw, x, u)
        distance = np.abs(np.asarray(alone) - np.asarray(predicted.mean)).max(axis=1)
        followed.add(int(distance.argmin()))
        assert distance.min() < 1e-6
        assert np.all(np.asarray(predicted.std) > 0)
    assert followed == set(range(MEMBERS))


def test_members_are_followed_equally_often(pair):
    _, many, params = pair
    belief = many.condition(params, rows())
    chosen, _ = jax.vmap(many.sample, (0, None))(jax.random.split(jax.random.key(1), 3000), belief)
    np.testing.assert_allclose(chosen.mean(0), 1 / MEMBERS, atol=4 * np.sqrt(2 / 9 / 3000))


def test_a_members_gradient_is_its_own(pair):
    """Changing one member changes neither the loss gradient nor the fit of another."""
    _, many, params = pair
    data = rows()
    context = many.prepare(data)
    gradient = jax.grad(many.loss)
    batch = Batch(*data[:3])
    before = gradient(params, jax.random.key(3), batch, context)
    moved = jax.tree.map(lambda leaf: leaf.at[0].add(0.3), params)
    after = gradient(moved, jax.random.key(3), batch, context)
    for old, new in zip(jax.tree.leaves(part(before, 1)), jax.tree.leaves(part(after, 1)), strict=True):
        np.testing.assert_array_equal(old, new)
    assert any(
        not np.allclose(old, new)
        for old, new in zip(jax.tree.leaves(part(before, 0)), jax.tree.leaves(part(after, 0)), strict=True)
    )


def test_members_see_different_rows(pair):
    """With equal parameters their gradients differ: each draws its own minibatch."""
    _, many, params = pair
    data = rows()
    equal = jax.tree.map(lambda leaf: jnp.broadcast_to(leaf[:1], leaf.shape), params)
    gradient = jax.grad(many.loss)(equal, jax.random.key(3), Batch(*data[:3]), many.prepare(data))
    assert any(not np.allclose(leaf[0], leaf[1]) for leaf in jax.tree.leaves(gradient))
