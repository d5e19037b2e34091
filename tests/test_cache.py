"""The folder of compiled and traced programs: made for its user alone, not used where others could write or it is
damaged."""

import os
from dataclasses import replace
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from pegasus_jax.cli import main
from pegasus_jax.presets import preset
from pegasus_jax.runs import cache, traced
from pegasus_jax.types import Trajectory
from test_train import call


def test_it_is_made_for_its_user_alone(tmp_path: Path) -> None:
    before = os.umask(0)
    try:
        assert cache.problem(tmp_path / "cache" / "pegasus_jax") is None
    finally:
        os.umask(before)
    assert (tmp_path / "cache" / "pegasus_jax").stat().st_mode & 0o777 == 0o700
    assert cache.problem(tmp_path / "cache" / "pegasus_jax") is None


@pytest.mark.parametrize(
    ("mode", "fine"), [(0o700, True), (0o755, True), (0o775, False), (0o757, False), (0o777, False)]
)
def test_others_must_not_write_there(mode: int, fine: bool, tmp_path: Path) -> None:
    (tmp_path / "cache").mkdir()
    (tmp_path / "cache").chmod(mode)
    assert (cache.problem(tmp_path / "cache") is None) == fine


def test_another_users_folder_is_not_used(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os, "getuid", lambda: tmp_path.stat().st_uid + 1)
    assert cache.problem(tmp_path) == "belongs to another user"
    (tmp_path / "file").write_text("")
    assert "cannot be used" in str(cache.problem(tmp_path / "file"))


def test_a_user_without_a_home_has_none(monkeypatch: pytest.MonkeyPatch) -> None:
    def homeless() -> Path:
        raise RuntimeError("Could not determine home directory.")

    monkeypatch.setattr(Path, "home", homeless)
    monkeypatch.delenv("XDG_CACHE_HOME", raising=False)
    monkeypatch.delenv("JAX_COMPILATION_CACHE_DIR", raising=False)
    assert cache.folder() is None
    main._remember_compilations()


def test_an_open_folder_is_named_and_the_command_goes_on(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("JAX_COMPILATION_CACHE_DIR")
    (tmp_path / "pegasus_jax").mkdir()
    (tmp_path / "pegasus_jax").chmod(0o777)
    done = call("evaluate", "nowhere", cwd=tmp_path, XDG_CACHE_HOME=str(tmp_path))
    assert done.returncode == 2
    assert "can be written by others" in done.stderr.splitlines()[0]
    assert "nowhere is not a run" in done.stderr.splitlines()[1]
    assert not list((tmp_path / "pegasus_jax").iterdir())


def test_a_traced_program_is_traced_once_and_a_damaged_one_again(tmp_path: Path) -> None:
    """With the same results, named tuples and a key among its arguments."""
    traces: list[int] = []

    def double(key: jax.Array, ran: Trajectory) -> tuple[Trajectory, jax.Array]:
        traces.append(1)
        return jax.tree.map(lambda leaf: 2 * leaf, ran), jax.random.normal(key)

    kept = traced.Store(tmp_path, "a job")
    given = jax.random.key(0), Trajectory(jnp.ones((3, 2)), jnp.ones((2, 1)), jnp.ones(2))

    def result() -> tuple[Trajectory, jax.Array]:
        fresh = lambda *arguments: double(*arguments)  # noqa: E731  (JAX remembers what it traced of a function)
        return kept.lower("double", fresh, {}, *given).compile()(*given)

    first, again = result(), result()
    assert len(traces) == 1
    (file,) = tmp_path.iterdir()
    file.write_bytes(file.read_bytes()[:-1] + b"?")
    for ran, drawn in (again, result()):
        assert isinstance(ran, Trajectory)
        np.testing.assert_array_equal(ran.x, first[0].x)
        np.testing.assert_array_equal(drawn, first[1])
    assert len(traces) == 2
    kept.lower("double", double, {}, given[0], given[1]._replace(cost=jnp.ones(3)))
    assert len(traces) == 3  # another shape is another program


def test_a_program_belongs_to_its_settings(monkeypatch: pytest.MonkeyPatch) -> None:
    config = preset("cartpole")

    def job(rows: int = 1024, **changes: object) -> str:
        found = traced.store(replace(config, **changes), 1, rows, alone=True)
        assert found is not None
        return found.job

    own = job()
    assert own == job(seed=3) == job(trials=2)
    assert own != job(rows=2048)  # no argument of the program that begins a run tells how long it may be
    others = {job(successor="better"), job(horizon=20), job(env_args=("pole_mass=0.4",)), job(x64=True)}
    others.add(job(search=replace(config.search, learning_rate=2e-3)))
    monkeypatch.setattr(traced, "code", lambda: "another version")
    assert len({own, *others, job()}) == 7


def test_what_a_user_wrote_is_traced_each_time() -> None:
    config = preset("cartpole")
    assert traced.store(replace(config, cost="costs:cost"), 1, 1024, alone=True) is None
    assert traced.store(replace(config, constraint="limits:far"), 1, 1024, alone=True) is None
    assert traced.store(config, 2, 1024, alone=False) is None
