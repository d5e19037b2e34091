"""Many seeds as one program: each leaves the run it would have left alone, and none disturbs another."""

import json
import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from benchmarks import once
from pegasus_jax.assembly.experiments import compose
from pegasus_jax.runs import machine, programs, store
from pegasus_jax.runs.programs import Program, over_seeds
from probes import EMITTERS, PLAIN, cart, tiny, unchecked
from test_train import TINY, call, fingerprint, program

# Fitted for longer: under a model that has hardly been, every policy costs 1, and Adam follows a gradient's rounding.
WORDS = once(*TINY, "trials=2", "seed=1", "fit.steps=400")


@pytest.fixture(scope="module", autouse=True)
def compiled_well() -> Iterator[None]:
    """A run's own options, as a user has them: without them rounding differs too much between one device and two."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XLA_FLAGS", "--xla_cpu_use_fusion_emitters=false" if EMITTERS else "")
        yield


@pytest.fixture(scope="module")
def study(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Seeds 1 and 2, together."""
    folder = tmp_path_factory.mktemp("study") / "both"
    done = call("train", *WORDS, "seeds=2", f"out={folder}", cwd=folder.parent)
    assert done.returncode == 0, done.stderr
    assert "of 2 seeds solved" in done.stderr
    return folder


@pytest.mark.slow
def test_a_seed_among_others_leaves_what_it_leaves_alone(study: Path, tmp_path: Path) -> None:
    """The same files with the same numbers, up to the order in which a batched product adds."""
    alone, among = tmp_path / "alone", study / "seed2"
    assert call("train", *once(*WORDS, "seed=2"), f"out={alone}", cwd=tmp_path).returncode == 0
    files = [
        {str(p.relative_to(run)) for p in run.rglob("*.*") if "events" not in p.name and "checkpoints/" not in str(p)}
        for run in (alone, among)
    ]
    assert files[0] == files[1]
    assert (alone / "config.yaml").read_text() == (among / "config.yaml").read_text()
    for trial in (1, 2):
        one, other = store.load_episode(alone, trial), store.load_episode(among, trial)
        assert one is not None
        assert other is not None
        for a, b in zip(one.trajectory[:3], other.trajectory[:3], strict=True):
            # Rounding, amplified by learning and by the plant: forces are up to 10 N, rates up to ten radians a second.
            np.testing.assert_allclose(a, b, rtol=1e-3, atol=5e-3)
    for a, b in zip(store.trials(alone), store.trials(among), strict=True):
        assert a.keys() == b.keys()
        for name in ("mean_cost", "objective_first", "objective_last", "objective_fresh"):
            assert a[name] == pytest.approx(b[name], abs=2e-4), name
    assert fingerprint(study / "seed1") != fingerprint(among)


@pytest.mark.slow
def test_evaluation_episodes_cost_the_same_side_by_side() -> None:
    experiment = compose(tiny(), cart())
    params = jax.vmap(experiment.init)(jax.random.split(jax.random.key(1), 2)).policy.params

    def costs(side_by_side: bool) -> np.ndarray:
        keys = jax.random.split(jax.random.key(0), (2, 3))
        return unchecked(Program(experiment, 1, 2, side_by_side=side_by_side).evaluate)(keys, params)

    alone, together = costs(False), costs(True)
    assert alone.shape == (2, 3, experiment.task.horizon)
    assert np.ptp(alone[..., -1]) > 0
    np.testing.assert_allclose(alone, together, atol=1e-5)


def test_the_options_of_another_compiler_are_left_out(monkeypatch: pytest.MonkeyPatch) -> None:
    """JAX's versions differ in them, and one that is unknown would end a run before its first episode."""
    monkeypatch.delenv("XLA_FLAGS", raising=False)  # of these tests, which speaks of the options too
    other: Any = {"xla_of_another_version": True}
    with pytest.raises(jax.errors.JaxRuntimeError, match="xla_of_another_version"):
        jax.jit(jnp.sin).lower(0.0).compile(compiler_options=other)
    known = {"xla_backend_optimization_level": 1}
    here = jax.default_backend()
    assert programs.compiler_options({here: other | known}) == known
    monkeypatch.setitem(programs.FAST_COMPILE, here, other | known)
    states = unchecked(Program(compose(tiny(), cart()), 1))("init", jax.random.key(0)[None])
    assert int(states.trial[0]) == 0


def test_a_gpu_is_told_how_to_run_loops_unless_the_user_says(monkeypatch: pytest.MonkeyPatch) -> None:
    """The options are ones that the JAX at hand has: its compiler for CPUs reads them too."""
    monkeypatch.delenv("XLA_FLAGS", raising=False)
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    whole, abreast = "xla_gpu_enable_command_buffer", "xla_gpu_command_buffer_scheduling_mode"
    untuned = {"xla_gpu_autotune_level", "xla_gpu_enable_triton_gemm"}
    assert {*programs.compiler_options(programs.FAST_RUN)} == {whole, abreast} | untuned
    assert {*programs.compiler_options(programs.FAST_COMPILE)} == {whole, abreast} | untuned
    monkeypatch.setenv("XLA_FLAGS", f"--{whole}=")
    assert {*programs.compiler_options(programs.FAST_RUN)} == {abreast} | untuned


CRASHES = """
import jax, jax.numpy as jnp
from pegasus_jax.runs import programs
a, b = jax.random.normal(jax.random.key(0), (2, 3, 1, 2, 2, 8, 8, 8))
summed = jax.jit(lambda a, b: jnp.sum(a * b, axis=3)).lower(a, b)
for options in (programs.FAST_RUN, programs.FAST_COMPILE, programs.ONCE):
    jax.block_until_ready(summed.compile(compiler_options=programs.compiler_options(options))(a, b))
"""


def test_a_reduction_of_many_dimensions_ends_no_process() -> None:
    """As it does with some versions of the compiler for CPUs, where nothing is said."""
    environment = {name: value for name, value in os.environ.items() if name != "XLA_FLAGS"}
    run = subprocess.run([sys.executable, "-c", CRASHES], env=environment, capture_output=True, text=True, check=False)
    assert run.returncode == 0, run.stderr


@pytest.mark.slow
def test_how_it_is_compiled_changes_no_result(monkeypatch: pytest.MonkeyPatch) -> None:
    """Graphs of kernels where these tests run on a GPU, wide vectors on a CPU. A few steps: rounding grows."""
    monkeypatch.delenv("XLA_FLAGS", raising=False)  # or the options that it speaks of would be left out
    assert not programs.FAST_RUN[jax.default_backend()].keys() - programs.compiler_options(programs.FAST_RUN).keys()
    experiment = compose(tiny(), cart())
    given = experiment.add_episode(state := experiment.init(jax.random.key(0)), experiment.collect(state))
    for part in (partial(experiment.fit, steps=10), partial(experiment.search, steps=5)):
        lowered = jax.jit(part).lower(given)
        (given, plainly), (_, as_a_run) = (
            lowered.compile(compiler_options=options)(given)
            for options in ({}, programs.compiler_options(programs.FAST_RUN) | EMITTERS)
        )
        jax.tree.map(partial(np.testing.assert_allclose, rtol=1e-4), as_a_run, plainly)


@pytest.mark.slow
def test_the_cores_of_a_processor_share_the_seeds(study: Path) -> None:
    """Two of them for two seeds; on a machine of one there is nothing to share."""
    devices = json.loads((study / "seed1" / "run.json").read_text())["devices"]
    assert len(devices) == min(2, machine.cpus())


@pytest.mark.parametrize(
    ("seeds", "particles", "threads"), [(1, 100, 1), (1, 1000, None), (3, 100, None), (1, None, None)]
)
def test_one_thread_imagines_few_particles(seeds: int, particles: int | None, threads: int | None) -> None:
    """As the system counts XLA's threads, in a process of its own; a machine of one CPU has one in any case."""
    code = f"""
import pathlib, jax
from pegasus_jax.runs.programs import share_cpus
share_cpus({seeds}, {particles})
jax.block_until_ready(jax.jit(lambda: jax.numpy.ones(3))())
print(sum("XLAEigen" in path.read_text() for path in pathlib.Path("/proc/self/task").glob("*/comm")))
"""
    environment = {k: v for k, v in os.environ.items() if k not in ("NPROC", "XLA_FLAGS", "JAX_NUM_CPU_DEVICES")}
    found = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=True)
    assert int(found.stdout) == (threads or machine.cpus())


@pytest.mark.slow
def test_killed_and_resumed_is_bit_equal(study: Path, tmp_path: Path) -> None:
    """Killed when one seed's second episode is on disk and the other's perhaps not."""
    folder = tmp_path / "killed"
    awaited = folder / "seed1" / "episodes" / "0002.npz"
    command = [*program("train"), *WORDS, "seeds=2", f"out={folder}"]
    process = subprocess.Popen(command, cwd=tmp_path, stderr=subprocess.DEVNULL)
    deadline = time.monotonic() + 240
    while not awaited.exists() and process.poll() is None and time.monotonic() < deadline:
        time.sleep(0.002)
    process.send_signal(signal.SIGKILL)
    process.wait()
    assert awaited.exists()
    done = call("train", f"resume={folder}", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    for seed in ("seed1", "seed2"):
        assert fingerprint(folder / seed) == fingerprint(study / seed)
        assert [row["trial"] for row in store.trials(folder / seed)] == [1, 2]


def alike(study: Path, other: Path) -> None:
    """Two folders of seeds hold the same runs, up to the order of sums."""
    for seed in ("seed1", "seed2"):
        for a, b in zip(store.trials(study / seed), store.trials(other / seed), strict=True):
            for name in ("mean_cost", "objective_first", "objective_last", "objective_fresh"):
                assert a[name] == pytest.approx(b[name], abs=2e-4), (seed, name)


@pytest.mark.campaign
def test_devices_that_share_seeds_and_particles_change_nothing(study: Path, tmp_path: Path) -> None:
    """Four devices made of this CPU, two for the seeds and two for the particles; resumed on one device."""
    folder, words = tmp_path / "mesh", once(*WORDS, "trials=1", "seeds=2", "mesh=2x2")
    done = call("train", *words, f"out={folder}", cwd=tmp_path, JAX_NUM_CPU_DEVICES="4")
    assert done.returncode == 0, done.stderr
    assert call("train", f"resume={folder}", "trials=2", cwd=tmp_path).returncode == 0
    alike(study, folder)


@pytest.mark.campaign
def test_processes_that_act_as_one_machine_change_nothing(study: Path, tmp_path: Path) -> None:
    with socket.socket() as free:
        free.bind(("localhost", 0))
        port = free.getsockname()[1]
    words = [*WORDS, "seeds=2", f"out={tmp_path / 'shared'}", f"coordinator=localhost:{port}", "processes=2"]
    command = [*program("train"), *words]
    both = [
        subprocess.Popen([*command, f"process={i}"], cwd=tmp_path, stderr=subprocess.PIPE, text=True) for i in range(2)
    ]
    errors = [process.communicate(timeout=300)[1] for process in both]
    assert [process.returncode for process in both] == [0, 0], errors
    assert "trial  2/2" in errors[0]
    assert "trial" not in errors[1]  # one speaks
    alike(study, tmp_path / "shared")


@pytest.mark.parametrize(
    ("word", "message"),
    [
        ("mesh=2x1", "needs 2 devices"),
        ("mesh=3x1", "mesh=1x1"),
        ("mesh=two", "mesh=4x1"),
        ("processes=2", "coordinator=HOST:PORT"),
        ("distributed=maybe", "neither true nor false"),
        ("distributed=true", "coordinator=HOST:PORT"),  # no SLURM and no MPI here
    ],
)
def test_devices_that_are_not_there_are_one_clear_line(word: str, message: str, tmp_path: Path) -> None:
    done = call("train", *WORDS, "seeds=2", word, cwd=tmp_path)
    assert (done.returncode, done.stderr.count("\n")) == (2, 1), done.stderr
    assert message in done.stderr
    assert not list(tmp_path.iterdir())


@pytest.mark.slow
def test_a_folder_of_seeds_is_drawn_and_kept(study: Path) -> None:
    plotted = call("plot", study, cwd=study.parent)
    assert plotted.returncode == 0, plotted.stderr
    assert (study / "learning.png").read_bytes().startswith(b"\x89PNG")
    again = call("train", *WORDS, "seeds=2", f"out={study}", cwd=study.parent)
    assert (again.returncode, again.stderr.count("\n")) == (2, 1)
    assert f"resume={study}" in again.stderr
    named = call("evaluate", study, cwd=study.parent)
    assert named.returncode == 2
    assert "seed1" in named.stderr
    evaluated = call("evaluate", study / "seed2", "trial=last", "episodes=1", "json=true", cwd=study.parent)
    assert json.loads(evaluated.stdout)["trial"] == 2


def test_one_environment_on_the_host_has_one_seed(tmp_path: Path) -> None:
    words = ["task=gym", "env=Pendulum-v1", "cost=math:cos", "seeds=2"]
    done = call("train", *words, cwd=tmp_path)
    assert (done.returncode, done.stderr.count("\n")) == (2, 1)
    assert "seeds=2" in done.stderr
    assert not list(tmp_path.iterdir())


def test_a_seed_that_diverges_leaves_the_others_as_they_are() -> None:
    """One seed's data turns to NaN: its own updates are skipped, the other's parameters are bit-equal."""
    exp = compose(tiny(trials=1, fit__steps=5, search__steps=5, **PLAIN), cart())
    over = jax.jit(over_seeds(exp.init, (0,), seeds=2)), jax.jit(over_seeds(exp.improve, (0,), seeds=2))
    init, improve = map(unchecked, over)
    states = init(jnp.stack([jax.random.key(0), jax.random.key(1)]))
    collect = unchecked(jax.jit(over_seeds(exp.collect, (0,), seeds=2)))
    add_episode = jax.jit(over_seeds(exp.add_episode, (0, 0), seeds=2))
    states = add_episode(states, collect(states))
    poisoned = states._replace(data=states.data._replace(y=states.data.y.at[1].set(jnp.nan)))
    (healthy, _), (mixed, info) = improve(states), improve(poisoned)
    for a, b in zip(jax.tree.leaves(healthy.policy), jax.tree.leaves(mixed.policy), strict=True):
        np.testing.assert_array_equal(a[0], b[0])
    fitted, searched = info
    assert np.array_equal(fitted.skipped, [0, 5])
    assert searched.skipped[0] == 0
    assert all(np.all(np.isfinite(leaf)) for leaf in jax.tree.leaves(mixed.policy.params))
