"""An ensemble: members are what they would be alone, and each particle follows one of them."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from pegasus_jax import tasks
from pegasus_jax.assembly.pieces import dynamics_of, policy_of
from pegasus_jax.assembly.searchers import blocks_of
from pegasus_jax.config import BNN, GP, MLP, Config, Lagrangian, model_word
from pegasus_jax.config_models import sized
from pegasus_jax.imagine.scenarios import draw
from pegasus_jax.models.ensemble import ensemble
from pegasus_jax.runs import config_io, writers
from pegasus_jax.tasks import assumed
from pegasus_jax.types import Batch, Dataset, Period, Prediction
from pegasus_jax.vectorized import for_particles
from probes import cart

MEMBERS = 3


@pytest.fixture(scope="module")
def pair():
    """A member and an ensemble of it; its parameters."""
    member = dynamics_of(BNN(hidden=(8,), dropout="none"), cart())
    many = ensemble(member, MEMBERS)
    return member, many, jax.jit(many.init)(jax.random.key(0))


def rows(size=40):
    x, u, y = (jax.random.normal(jax.random.key(i), (size, width)) for i, width in enumerate((2, 1, 2)))
    return Dataset(x, u, y, jnp.int32(size))


def part(tree, index):
    return jax.tree.map(lambda leaf: leaf[index], tree)


def test_a_particle_follows_one_member(pair):
    member, many, params = pair
    data = rows()
    x, u = jnp.array([0.3, -0.2]), jnp.array([0.5])

    def of(dynamics):
        def predicted(params, key):
            posterior = dynamics.posterior(params, data)
            return dynamics.apply(posterior, dynamics.sample(key, posterior), x, u)

        return jax.jit(predicted)

    one, several = of(member), of(many)
    alone = [one(part(params, index), jax.random.key(9)).mean for index in range(MEMBERS)]
    followed = set()
    for seed in range(12):
        predicted = several(params, jax.random.key(seed))
        distance = np.abs(np.asarray(alone) - np.asarray(predicted.mean)).max(axis=1)
        followed.add(int(distance.argmin()))
        assert distance.min() < 1e-6
        assert np.all(np.asarray(predicted.std) > 0)
    assert followed == set(range(MEMBERS))


def test_members_are_followed_equally_often(pair):
    _, many, params = pair
    posterior = jax.jit(many.posterior)(params, rows())
    chosen, _ = jax.vmap(many.sample, (0, None))(jax.random.split(jax.random.key(1), 3000), posterior)
    np.testing.assert_allclose(chosen.mean(0), 1 / MEMBERS, atol=4 * np.sqrt(2 / 9 / 3000))


@pytest.mark.parametrize("particles", [2, 6, 7])
def test_particles_together_are_what_each_would_be_alone(pair, particles):
    """Dealt in turn, they need no other member's arithmetic; drawn one by one, they are not mistaken for dealt ones."""
    _, many, params = pair
    posterior = jax.jit(many.posterior)(params, rows())
    keys = lambda: jax.random.split(jax.random.key(1), particles)  # noqa: E731
    x, u = (jax.random.normal(jax.random.key(i), (particles, width)) for i, width in enumerate((2, 1)))
    each = jax.jit(jax.vmap(many.apply, (None, 0, 0, 0)))
    together = jax.jit(for_particles(many.apply))
    dealt = jax.jit(many.deal)(keys(), posterior)
    drawn = jax.jit(jax.vmap(many.sample, (0, None)))(keys(), posterior)
    assert np.argmax(dealt.chosen, 1).tolist() == [k % MEMBERS for k in range(particles)]
    for draws in (dealt, drawn):
        for one, other in zip(together(posterior, draws, x, u), each(posterior, draws, x, u), strict=True):
            np.testing.assert_allclose(one, other, rtol=1e-5, atol=1e-6)
    still = many._replace(apply=lambda posterior, draw, x, u: Prediction(0 * x, 0 * x))  # somebody's own
    assert not np.any(for_particles(still.apply)(posterior, dealt, x, u).mean)


def test_a_dealt_particles_draw_is_of_its_member():
    """Where noise is learned, the k-th particle's is that of member k modulo their number, drawn by its own key."""
    member = dynamics_of(BNN(hidden=(8,), dropout="log_normal"), cart())
    many = ensemble(member, MEMBERS)
    posterior = jax.jit(lambda key: many.posterior(many.init(key), rows()))(jax.random.key(0))
    dealt = jax.jit(many.deal)(jax.random.split(jax.random.key(1), 7), posterior)
    sample = jax.jit(member.sample)
    for k, key in enumerate(jax.random.split(jax.random.key(1), 7)):
        alone = sample(key, part(posterior, k % MEMBERS))
        for one, other in zip(jax.tree.leaves(alone), jax.tree.leaves(part(dealt.own, k)), strict=True):
            np.testing.assert_allclose(one, other, rtol=1e-6)


def test_as_many_imagined_particles_follow_each_member(pair):
    _, many, params = pair
    posterior = jax.jit(many.posterior)(params, rows())
    task, policy = cart(), policy_of(MLP(), cart())
    drawn = draw(jax.random.key(0), 0, posterior, blocks=blocks_of(13, task, many, policy), period=Period())
    assert drawn.dynamics.chosen.sum(0).tolist() == [5, 4, 4]


def test_a_members_gradient_is_its_own(pair):
    """Changing one member changes neither the loss gradient nor the fit of another."""
    _, many, params = pair
    data = rows()
    context = many.prepare(data)
    gradient = jax.jit(jax.grad(many.loss))
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
    gradient = jax.jit(jax.grad(many.loss))(equal, jax.random.key(3), Batch(*data[:3]), many.prepare(data))
    assert any(not np.allclose(leaf[0], leaf[1]) for leaf in jax.tree.leaves(gradient))


@pytest.mark.parametrize(("states", "size"), [(1, 1), (4, 1), (6, 1), (7, 5), (10, 5), (11, 20), (13, 20), (40, 20)])
def test_a_plant_of_more_states_has_more_networks_and_their_whole_divergence(states, size):
    """What is said stays, and null becomes a number of the plant's size alone: docs/decisions.md 0017."""
    chosen = sized(BNN(ensemble_size=None, kl_weight=None), states)
    assert (chosen.ensemble_size, chosen.kl_weight) == (size, 1.0 if size > 1 else 0.1)
    assert sized(BNN(ensemble_size=2, kl_weight=None), states).kl_weight == 1.0
    assert sized(BNN(ensemble_size=None, kl_weight=0.3), states).kl_weight == 0.3
    for said in (BNN(), BNN(ensemble_size=7, kl_weight=0.0), Lagrangian(ensemble_size=5)):
        assert sized(said, states) == said


@pytest.mark.parametrize(("states", "size"), [(6, 1), (7, 5), (11, 20)])
def test_the_model_of_a_task_has_as_many_networks_as_its_states_ask_for(states, size):
    task = cart()._replace(state_names=tuple(f"x{i}" for i in range(states)))
    by_states, said = (
        jax.eval_shape(dynamics_of(config, task).init, jax.random.key(0))
        for config in (BNN(hidden=(8,), ensemble_size=None), BNN(hidden=(8,), ensemble_size=size))
    )
    assert jax.tree.map(jnp.shape, by_states) == jax.tree.map(jnp.shape, said)


def test_a_run_keeps_the_numbers_that_it_began_with(tmp_path):
    """Its folder holds them, so that it goes on where a later version chooses others for null."""
    config = Config(task="swimmer_knife_edge", model=BNN(ensemble_size=None, kl_weight=None))
    writers.run_folders({3: tmp_path}, config, tasks.make(config.task), "pegasus-train").begin(0)
    kept = config_io.load(tmp_path / "config.yaml")
    assert (kept.seed, kept.model) == (3, BNN(ensemble_size=5, kl_weight=1.0))


def test_a_run_says_that_its_states_ask_for_five_networks():
    """Who chose a number is not told it again."""
    default = BNN(ensemble_size=None, kl_weight=None)
    (told,) = assumed.networks(default, 7)
    assert told.startswith("7 states: the model is 5 networks")
    assert [model_word(sized(default, states)) for states in (6, 7)] == ["log_normal", "log_normal of 5"]
    quiet = ((default, 6), (BNN(), 7), (BNN(ensemble_size=5), 7), (Lagrangian(ensemble_size=5), 7), (GP(), 7))
    assert [assumed.networks(model, states) for model, states in quiet] == [[]] * 5
