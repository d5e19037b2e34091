"""Programs of earlier commands: found where nothing they are made of has changed, and the same numbers."""

import json
import os
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from pegasus_jax import compiled, settings
from pegasus_jax.program import Jitted
from test_train import TINY, call, fingerprint


@pytest.fixture
def cache(tmp_path):
    """JAX's cache folder, for one test."""
    before = jax.config.jax_compilation_cache_dir
    jax.config.update("jax_compilation_cache_dir", str(tmp_path))
    yield tmp_path
    jax.config.update("jax_compilation_cache_dir", before)


def counted(counts, key, x):
    counts.append(1)
    own, drawn = jax.random.split(key)
    return {"drawn": drawn, "sum": x + jax.random.normal(own, x.shape)}


def test_a_kept_program_is_not_traced_again_and_gives_the_same(tmp_path):
    counts, kept = [], tmp_path / "shelf" / "sum"
    first, second = (Jitted(partial(counted, counts), kept=kept)(jax.random.key(3), jnp.arange(4.0)) for _ in range(2))
    assert len(counts) == 1
    np.testing.assert_array_equal(first["sum"], second["sum"])
    assert jnp.all(first["drawn"] == second["drawn"])


def test_what_cannot_be_read_is_compiled(tmp_path):
    path, x = tmp_path / "shelf" / "twice", jnp.arange(3.0)
    path.parent.mkdir()
    for content in (b"", b"not a program", os.urandom(64)):
        path.write_bytes(content)
        assert compiled.load(path, (x,)) is None
        np.testing.assert_array_equal(Jitted(lambda x: 2 * x, kept=path)(x), [0, 2, 4])
    kept = path.read_bytes()
    path.write_bytes(kept[: len(kept) // 2])  # by a disk that was full
    assert compiled.load(path, (x,)) is None


def test_a_program_for_other_arguments_is_not_taken(tmp_path):
    path, x = tmp_path / "shelf" / "twice", jnp.arange(3.0)
    Jitted(lambda x: 2 * x, kept=path)(x)
    assert compiled.load(path, (x,)) is not None
    assert compiled.load(path, (jnp.arange(4.0),)) is None
    assert compiled.load(path, (jnp.arange(3),)) is None
    assert compiled.load(path, ((x,),)) is None


def test_a_shelf_is_that_of_its_settings_seeds_flags_and_sources(cache, monkeypatch, tmp_path):
    config = settings.parse({"task": "cartpole"})
    shelves = [compiled.shelf(config, seeds=1)]
    assert compiled.shelf(config, seeds=1) == shelves[0]
    shelves += [compiled.shelf(settings.parse({"task": "cartpole", "search.limit": "9"}), seeds=1)]
    shelves += [compiled.shelf(config, seeds=2)]
    monkeypatch.setenv("XLA_FLAGS", "--xla_cpu_multi_thread_eigen=false")
    shelves += [compiled.shelf(config, seeds=1)]
    with jax.default_matmul_precision("float32"):
        shelves += [compiled.shelf(config, seeds=1)]
    monkeypatch.setattr(compiled, "processor", lambda: "another")
    shelves += [compiled.shelf(config, seeds=1)]
    source = tmp_path / "some_plants" / "__init__.py"
    source.parent.mkdir()
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setattr(compiled, "PACKAGES", ("pegasus_jax", "some_plants"))
    for gravity in ("9.81", "9.82"):
        source.write_text(f"gravity = {gravity}\n")
        shelves += [compiled.shelf(config, seeds=1)]
    assert len({*shelves}) == 8
    assert all(shelf.is_relative_to(cache) for shelf in shelves)


def test_tasks_of_the_users_files_have_no_shelf(cache):
    words = {"task": "gym", "env": "Pendulum-v1", "cost": "math:cos"}
    assert compiled.shelf(settings.parse(words), seeds=1) is None
    jax.config.update("jax_compilation_cache_dir", "gs://somewhere")
    assert compiled.shelf(settings.parse({"task": "cartpole"}), seeds=1) is None


def test_old_shelves_go(tmp_path, monkeypatch):
    monkeypatch.setattr(compiled, "KEPT", 2)
    programs = [tmp_path / name / "twice" for name in "abc"]
    for now, path in enumerate(programs):
        Jitted(lambda x: 2 * x, kept=path)(jnp.arange(3.0))
        os.utime(path.parent, (now, now))
        if now == 1:
            assert compiled.load(programs[0], (jnp.arange(3.0),)) is not None  # used again: b is the oldest
    assert [path.exists() for path in programs] == [True, False, True]


def test_a_command_given_again_traces_nothing_and_learns_the_same(tmp_path):
    """In processes of their own: the second has lowered no call of LAPACK, which moment matching needs."""
    words = [*TINY, "trials=1"]
    runs = [tmp_path / name for name in ("first", "again")]
    for run in runs:
        done = call("train", *words, f"out={run}", cwd=tmp_path, XDG_CACHE_HOME=str(tmp_path / "cache"))
        assert done.returncode == 0, done.stderr
    (shelf,) = (tmp_path / "cache" / "pegasus_jax" / "programs").iterdir()
    assert {"init", "episode", "absorb", "fit", "search", "imagine"} <= {path.name for path in shelf.iterdir()}
    assert fingerprint(runs[0]) == fingerprint(runs[1])
    waited = [json.loads((run / "trials.jsonl").read_text())["seconds"]["compile"] for run in runs]
    assert waited[1] < 0.5 * waited[0]
