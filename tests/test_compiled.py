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
    counts, kept = [], tmp_path / "shelf-sum"
    first, second = (Jitted(partial(counted, counts), kept=kept)(jax.random.key(3), jnp.arange(4.0)) for _ in range(2))
    assert len(counts) == 1
    np.testing.assert_array_equal(first["sum"], second["sum"])
    assert jnp.all(first["drawn"] == second["drawn"])


def double(x):
    return 2 * x


def doubled(path, numbers=3, function=double, **options):
    """The names of the files after a program for `function` is kept at `path`."""
    x = jnp.arange(float(numbers))
    np.testing.assert_array_equal(Jitted(function, kept=path, **options)(x), function(x))
    return {file.name for file in path.parent.iterdir()}


def test_the_same_lowered_program_is_one_executable(tmp_path):
    """Under other settings too; not if it is compiled otherwise, or takes another tree of arguments."""
    (executable,) = doubled(tmp_path / "a") - {"a"}
    made = (tmp_path / executable).stat().st_ino
    assert doubled(tmp_path / "b") == {"a", "b", executable}
    assert (tmp_path / executable).stat().st_ino == made
    brief = {"xla_backend_optimization_level": 1}
    assert len(doubled(tmp_path / "c", compiler_options=brief) - {"a", "b", "c", executable}) == 1
    np.testing.assert_array_equal(Jitted(lambda x: 2 * x[0], kept=tmp_path / "d")((jnp.arange(3.0),)), [0, 2, 4])
    assert len([*tmp_path.iterdir()]) == 7


def test_what_cannot_be_read_is_compiled_and_kept(tmp_path):
    (executable,) = doubled(tmp_path / "a") - {"a"}
    whole = (tmp_path / executable).read_bytes()
    for content in (b"", b"not a program", os.urandom(64), whole[: len(whole) // 2]):  # by a disk that was full
        (tmp_path / executable).write_bytes(content)
        assert compiled.read(tmp_path / executable, (jnp.arange(3.0),)) is None
        doubled(tmp_path / "a")
        assert compiled.read(tmp_path / executable, (jnp.arange(3.0),)) is not None
    for content in (b"", b"\x00", b"../..", os.urandom(64)):
        (tmp_path / "a").write_bytes(content)
        assert doubled(tmp_path / "a") == {"a", executable}
        assert (tmp_path / "a").read_text() == executable


def test_a_program_for_other_arguments_is_not_taken(tmp_path):
    (executable,) = doubled(tmp_path / "a") - {"a"}
    for arguments in ((jnp.arange(4.0),), (jnp.arange(3),), ((jnp.arange(3.0),),)):
        assert compiled.read(tmp_path / executable, arguments) is None
    assert len(doubled(tmp_path / "a", 4)) == 3


def test_what_was_not_used_for_long_goes(tmp_path, monkeypatch):
    monkeypatch.setattr(compiled, "KEPT", 4)
    (first,) = doubled(tmp_path / "a") - {"a"}
    others = doubled(tmp_path / "b", function=lambda x: 3 * x) - {"a", first}
    for file in tmp_path.iterdir():
        os.utime(file, (0, 0))
    doubled(tmp_path / "a")  # used again
    kept = doubled(tmp_path / "c", function=lambda x: 4 * x)
    assert {"a", "c", first} < kept
    assert len(kept) == 4
    assert not kept & others


def test_a_disk_that_is_full_keeps_nothing_and_stops_nobody(tmp_path, monkeypatch):
    def full(path, write):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(compiled.files, "write_whole", full)
    assert not doubled(tmp_path / "a")


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
    known = compiled.machine.processor()
    monkeypatch.setattr(compiled.machine, "processor", lambda: {**known, "flags": "others"})
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


def test_a_command_given_again_traces_nothing_and_learns_the_same(tmp_path):
    """In processes of their own: the second has lowered no call of LAPACK, which moment matching needs."""
    words = [*TINY, "trials=1"]
    places = {"XDG_CACHE_HOME": str(tmp_path / "cache"), "XLA_FLAGS": ""}  # executables as a user's are
    runs = [tmp_path / name for name in ("first", "again")]
    for run in runs:
        done = call("train", *words, f"out={run}", cwd=tmp_path, **places)
        assert done.returncode == 0, done.stderr
    programs = tmp_path / "cache" / "pegasus_jax" / "programs"
    files = {*programs.iterdir()}
    assert {"init", "episode", "absorb", "fit", "search1", "imagine"} <= {file.name.partition("-")[2] for file in files}
    done = call("evaluate", runs[0], "episodes=2", cwd=tmp_path, **places)
    assert done.returncode == 0, done.stderr
    assert {*programs.iterdir()} == files  # nor does what looks at the run
    assert fingerprint(runs[0]) == fingerprint(runs[1])
    waited = [json.loads((run / "trials.jsonl").read_text())["seconds"]["compile"] for run in runs]
    assert waited[1] < 0.5 * waited[0]
