"""The folder of compiled programs: made for its user alone, and not used where others could write."""

import os
from pathlib import Path

import pytest

from pegasus_jax.cli import main
from pegasus_jax.runs import cache
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
