"""One loop, several writers: what is learned does not depend on where it is written."""

import dataclasses
from collections.abc import Callable
from threading import Event
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from pegasus_jax.assembly.experiments import compose
from pegasus_jax.checks import RunError
from pegasus_jax.config import BNN
from pegasus_jax.episode import Episode
from pegasus_jax.experiment import run
from pegasus_jax.runs import checkpoint, store, writers
from pegasus_jax.runs.beside import beside
from pegasus_jax.runs.display import Display
from pegasus_jax.runs.job import Job, first_states
from pegasus_jax.runs.programs import Program
from pegasus_jax.runs.study import ROUNDED, curves, one_json, rounded
from pegasus_jax.runs.train import learn
from pegasus_jax.runs.writers import Writer
from pegasus_jax.types import RunState, Trajectory
from probes import PLAIN, cart, same, tiny, unchecked

SEEDS, TRIALS = [5, 6], 2
CONFIG = tiny(trials=TRIALS, eval_episodes=3, fit__steps=20, search__steps=10, **PLAIN)


@pytest.fixture(scope="module")
def job() -> Job:
    """Two seeds of a cart, with parts that every test of this file shares."""
    experiment = compose(CONFIG, cart())
    program = Program(experiment, CONFIG.search.steps, len(SEEDS))
    return Job(CONFIG, SEEDS, experiment, program, Display(TRIALS, quiet=True), writers.nothing(len(SEEDS)))


def learned(job: Job, writer: Writer) -> RunState:
    return unchecked(lambda: learn(job._replace(writer=writer), first_states(job)))()


@pytest.fixture(scope="module")
def unwritten(job: Job) -> RunState:
    """The states after the last trial of a job that wrote nothing."""
    return learned(job, job.writer)


@pytest.mark.slow
def test_folders_hold_what_is_learned_without_them(job: Job, unwritten: RunState, tmp_path) -> None:
    runs = {seed: tmp_path / f"seed{seed}" for seed in SEEDS}
    states = learned(job, writers.run_folders(runs, CONFIG, job.experiment.task, ""))
    assert same(states.policy.params, unwritten.policy.params)
    assert same(states.data, unwritten.data)
    like = jax.eval_shape(job.experiment.init, jax.random.key(0))
    for index, folder in enumerate(runs.values()):
        kept = checkpoint.restore(folder, TRIALS, like)
        assert checkpoint.fingerprint(kept) == checkpoint.fingerprint(writers.part(unwritten, index))
        assert len(store.trials(folder)) == TRIALS


def test_a_study_keeps_the_rows_of_the_folders(job: Job, unwritten: RunState, tmp_path) -> None:
    """A study's curves are the columns of trials.jsonl, and are handed over after every trial."""
    handed: list[dict[str, Any]] = []
    states = learned(job, one_json(CONFIG, SEEDS, job.experiment.task, handed.append))
    assert same(states.policy.params, unwritten.policy.params)
    runs = {seed: tmp_path / f"seed{seed}" for seed in SEEDS}
    learned(job, writers.run_folders(runs, CONFIG, job.experiment.task, ""))
    rows = [store.trials(folder) for folder in runs.values()]
    assert [np.shape(result["mean_cost"]) for result in handed] == [(2, 1), (2, 2)]
    for name in ("mean_cost", "episode_cost", "objective_last", "objective_fresh", "saturated", "calibration"):
        columns = [[np.nan if row[name] is None else row[name] for row in seed] for seed in rows]
        assert handed[-1][name] == rounded(columns), name
    assert handed[-1]["success_rate"] == [[row["success_rate"] for row in seed] for seed in rows]
    assert handed[-1]["seeds"] == SEEDS
    assert handed[-1]["config"]["search.steps"] == 10
    assert handed[-1]["calibration"][0][0] is None  # there was no model before the first trial


def test_a_study_keeps_the_number_of_networks_that_it_was_made_with() -> None:
    """A later version may choose another number for null."""
    config = dataclasses.replace(CONFIG, model=BNN(ensemble_size=None, kl_weight=None))
    eight = cart()._replace(state_names=tuple("abcdefgh"))
    kept = curves(config, SEEDS, [], eight)["config"]
    assert (kept["model.ensemble_size"], kept["model.kl_weight"]) == (5, 1.0)


def test_a_study_says_how_long_its_episodes_were() -> None:
    """Those of seeds that stopped early are shorter; the curves have one time for all."""
    row = dict.fromkeys((*ROUNDED, "success_rate"), 0.5) | {"skipped_updates": 0}
    ends = [(0.2, 2.0), (0.5, 4.0)]  # [s] of plant time after each trial, of two seeds
    trials = [[row | {"plant_seconds": seconds} for seconds in seeds] for seeds in ends]
    assert curves(CONFIG, SEEDS, trials, cart())["plant_seconds"] == [1.1, 2.25]


def test_the_loop_learns_what_the_whole_run_as_one_program_learns(job: Job, unwritten: RunState) -> None:
    """`experiment.run` is one jitted scan over trials; the loop calls its parts. Equal up to the order of sums."""
    whole = unchecked(jax.jit(jax.vmap(run(job.experiment, TRIALS, 3))))
    states, info = whole(jnp.stack([jax.random.key(seed) for seed in SEEDS]))
    for a, b in zip(
        jax.tree.leaves((states.policy.params, states.model.params, states.data)),
        jax.tree.leaves((unwritten.policy.params, unwritten.model.params, unwritten.data)),
        strict=True,
    ):
        np.testing.assert_allclose(a, b, rtol=1e-3, atol=1e-4)
    handed: list[dict[str, Any]] = []
    learned(job, one_json(CONFIG, SEEDS, job.experiment.task, handed.append))
    np.testing.assert_allclose(handed[-1]["mean_cost"], info.evaluation.mean((2, 3)), atol=1e-3)


def recorder(calls: list[tuple], episode: Callable[..., None] | None = None) -> Writer:
    """A writer that notes what it is called with."""

    def note(index: int, trial: int, ran: Episode, policy: int) -> None:
        calls.append(("episode", trial, index, policy))
        if episode is not None:
            episode()

    return writers.nothing(len(SEEDS))._replace(
        begin=lambda done: calls.append(("begin", done)),
        episode=note,
        imagined=lambda trial, successor: calls.append(("imagined", trial)),
        trial=lambda trial, states, rows: calls.append(("trial", trial)),
    )


def test_a_writer_has_the_episode_before_anything_is_learned_from_it(job: Job) -> None:
    calls: list[tuple] = []
    learned(job, recorder(calls))
    assert calls[:4] == [("begin", 0), ("episode", 1, 0, 0), ("episode", 1, 1, 0), ("imagined", 1)]
    # The second episode does not wait for what is written of the first trial.
    rest = [call[:2] for call in calls[4:]]
    assert [call for call in rest if call != ("trial", 1)] == [("episode", 2)] * 2 + [("imagined", 2), ("trial", 2)]
    assert ("trial", 1) in rest[:-1]

    def full() -> None:
        raise OSError("no space left")

    calls.clear()
    with pytest.raises(OSError, match="no space"):
        learned(job, recorder(calls, full))
    assert calls == [("begin", 0), ("episode", 1, 0, 0)]


def test_what_a_writer_has_is_not_run_again(job: Job, unwritten: RunState) -> None:
    """The loop goes through its own first episodes, handed back, without a call of `episode`, to the same states."""
    kept: list[Episode] = []
    first = writers.nothing(2)._replace(episode=lambda index, trial, ran, policy: kept.append(ran))
    learned(job, first)
    calls: list[tuple] = []
    states = learned(job, recorder(calls)._replace(known=lambda trial: list(kept[2 * trial - 2 : 2 * trial])))
    assert same(states.policy.params, unwritten.policy.params)
    assert not [call for call in calls if call[0] == "episode"]


def test_a_run_ends_where_nothing_can_be_learned_and_a_study_has_null(job: Job) -> None:
    """Episodes of no numbers, handed back for both seeds: no model can be fitted to them."""
    horizon = job.experiment.task.horizon
    nan = Trajectory(jnp.full((horizon + 1, 2), jnp.nan), jnp.zeros((horizon, 1)), jnp.zeros(horizon))
    broken = writers.nothing(2)._replace(known=lambda trial: [Episode(nan, "horizon")] * 2)
    with pytest.raises(RunError, match="trial 1: the loss of the model's fit is nan") as refusal:
        learned(job, broken._replace(problem=writers.refuse))
    assert "\n" not in str(refusal.value)
    handed: list[dict[str, Any]] = []
    study = one_json(CONFIG, SEEDS, job.experiment.task, handed.append)._replace(known=broken.known)
    learned(job, study)
    assert [len(curve) for curve in handed[-1]["objective_last"]] == [TRIALS, TRIALS]
    assert handed[-1]["objective_last"][0] == [None] * TRIALS


def test_what_is_done_beside_is_not_waited_for_and_its_error_is_heard() -> None:
    """An episode begins before the row of the trial before is written; the block ends after that, or with its error."""
    go, order = Event(), []

    def slow() -> None:
        go.wait(10)
        order.append("written")

    with beside() as hand:
        hand(slow)
        order.append("next episode")
        hand.check()
        go.set()
    assert order == ["next episode", "written"]

    def full() -> None:
        raise OSError("no space left")

    def both(first: Callable[[], None], second: Callable[[], None]) -> None:
        with beside() as hand:
            hand(first)
            second()

    with pytest.raises(OSError, match="no space"):
        both(full, lambda: None)
    with pytest.raises(OSError, match="no space"):  # an error elsewhere: what was learned is kept first
        both(lambda: order.append("kept"), full)
    assert order[2:] == ["kept"]
