"""What users install: the wheel is complete, the lock is portable, nothing names the machine it was written on."""

from __future__ import annotations

import re
import subprocess
import sys
import tomllib
import zipfile
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

ROOT = Path(__file__).resolve().parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
LOCK = (ROOT / "requirements.lock").read_text()
PACKAGES = {"pegasus_jax": ROOT / "src" / "pegasus_jax", "pegasus_envs": ROOT / "envs" / "pegasus_envs"}


def locked() -> list[Requirement]:
    """The pins of the lock, one for each package and Python: `jax==0.10.2 ; python_full_version < '3.12'`."""
    return [Requirement(line.rstrip("\\ ")) for line in LOCK.splitlines() if re.match(r"[a-z0-9]", line)]


def pins(name: str) -> set[str]:
    """Every version at which the lock pins a package."""
    found = {next(iter(pin.specifier)).version for pin in locked() if canonicalize_name(pin.name) == name}
    assert found, f"{name} is not in requirements.lock: make lock"
    return found


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> zipfile.ZipFile:
    folder = tmp_path_factory.mktemp("wheel")
    command = [sys.executable, "-m", "hatchling", "build", "-t", "wheel", "-d", str(folder)]
    built = subprocess.run(command, cwd=ROOT, capture_output=True, text=True)
    assert built.returncode == 0, built.stdout + built.stderr
    (path,) = folder.glob("*.whl")
    return zipfile.ZipFile(path)


def test_wheel_holds_both_packages_and_their_assets(wheel: zipfile.ZipFile) -> None:
    expected = {
        f"{name}/{path.relative_to(folder).as_posix()}"
        for name, folder in PACKAGES.items()
        for path in folder.rglob("*")
        if path.suffix in {".py", ".xml"} or path.name == "py.typed"
    }
    assert {"pegasus_jax/__init__.py", "pegasus_jax/py.typed", "pegasus_envs/__init__.py"} <= expected
    assert any(re.fullmatch(r"pegasus_envs/assets/\w+\.xml", name) for name in expected)
    assert expected <= set(wheel.namelist())


def test_wheel_holds_nothing_else(wheel: zipfile.ZipFile) -> None:
    tops = {name.split("/")[0] for name in wheel.namelist()}
    assert tops == {*PACKAGES, f"pegasus_jax-{PROJECT['version']}.dist-info"}
    assert any(name.endswith("licenses/LICENSE") for name in wheel.namelist())


def test_wheel_has_the_commands(wheel: zipfile.ZipFile) -> None:
    (path,) = (name for name in wheel.namelist() if name.endswith("entry_points.txt"))
    text = wheel.read(path).decode()
    for command in ("pegasus-train", "pegasus-eval", "pegasus-plot", "pegasus-play", "pegasus-figures"):
        assert f"{command} = pegasus_jax.cli.main:" in text


def test_lock_names_no_host_and_no_path() -> None:
    # One pin, its hashes, and comments; no URL, option, path or index.
    for number, line in enumerate(LOCK.splitlines(), 1):
        form = r"#.*|[a-z0-9.-]+==[\w.]+( ; [^\\]+)?( \\)?|    --hash=sha256:[0-9a-f]{64}( \\)?"
        assert re.fullmatch(form, line), f"requirements.lock:{number}: {line}"
        assert not re.search(r"http|://|/|index|find-links", line), f"requirements.lock:{number}: {line}"


def test_every_pin_has_hashes() -> None:
    for entry in re.split(r"\n(?=[a-z0-9])", LOCK)[1:]:
        assert "--hash=sha256:" in entry, entry.splitlines()[0]


def test_lock_satisfies_pyproject() -> None:
    for text in PROJECT["dependencies"] + PROJECT["optional-dependencies"]["dev"]:
        requirement = Requirement(text)
        for version in pins(canonicalize_name(requirement.name)):
            assert requirement.specifier.contains(version), f"{text}, but {version} is locked: make lock"


def test_lock_leaves_out_the_heavy_extras() -> None:
    names = {canonicalize_name(pin.name) for pin in locked()}
    assert not {name for name in names if name == "torch" or name.startswith(("nvidia", "jax-cuda"))}


def test_mujoco_and_mjx_are_one_minor_version() -> None:
    # mujoco 4.0 beside mujoco-mjx 3.17 resolves, and integrates differently (RK4: 1.6e-5 after 150 steps).
    minors = {name: {version.rsplit(".", 1)[0] for version in pins(name)} for name in ("mujoco", "mujoco-mjx")}
    assert len(minors["mujoco"]) == 1
    assert minors["mujoco"] == minors["mujoco-mjx"]
    assert {"mujoco", "mujoco-mjx"} <= {Requirement(text).name for text in PROJECT["dependencies"]}


def test_users_do_not_install_what_only_developers_need() -> None:
    runtime = {canonicalize_name(Requirement(text).name) for text in PROJECT["dependencies"]}
    developer = {canonicalize_name(Requirement(text).name) for text in PROJECT["optional-dependencies"]["dev"]}
    assert not runtime & developer


def test_citation_has_the_version() -> None:
    assert f"\nversion: {PROJECT['version']}\n" in (ROOT / "CITATION.cff").read_text()


def tracked() -> list[Path]:
    try:
        listing = subprocess.run(["git", "ls-files", "-z"], cwd=ROOT, check=True, capture_output=True, text=True).stdout
    except (OSError, subprocess.CalledProcessError):
        pytest.skip("not a git checkout")
    return [path for name in listing.split("\0") if name and (path := ROOT / name).is_file()]


def test_no_tracked_file_names_this_machine() -> None:
    machine = re.compile(rb"(?<![\w./~$}>-])/(?:work|root|home|Users|opt)/\w")
    found = []
    for path in tracked():
        data = path.read_bytes()
        if b"\0" in data:
            continue  # a picture
        found += [
            f"{path.relative_to(ROOT)}:{number}: {line.decode(errors='replace').strip()[:120]}"
            for number, line in enumerate(data.splitlines(), 1)
            if machine.search(line) or (str(ROOT).encode() in line and len(ROOT.parts) > 2)
        ]
    assert not found


def test_models_are_not_ignored() -> None:
    if not tracked():
        pytest.skip("nothing tracked")
    path = "envs/pegasus_envs/assets/some_new_model.xml"
    assert subprocess.run(["git", "check-ignore", "-q", path], cwd=ROOT).returncode == 1
