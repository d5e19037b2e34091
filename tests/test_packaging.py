"""What users install: the wheel is complete, the lock is portable, nothing names the machine it was written on."""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
import sys
import tomllib
import zipfile
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import pytest
import yaml
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

from pegasus_jax.cli.train import understood

ROOT = Path(__file__).resolve().parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
MINORS = [found for line in PROJECT["classifiers"] for found in re.findall(r"Python :: (3\.\d+)$", line)]
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
    (about,) = tops - {*PACKAGES}
    assert re.fullmatch(r"pegasus_jax-\d+\.\d+\.\d+.*\.dist-info", about)
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
        assert not re.search(r"https?:|://|/|--index|find-links", line), f"requirements.lock:{number}: {line}"


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


def test_the_citation_is_of_the_newest_release() -> None:
    release = r"^## \[(\d+\.\d+\.\d+)\] - (\d{4}-\d\d-\d\d)$"
    version, date = re.findall(release, (ROOT / "CHANGELOG.md").read_text(), re.MULTILINE)[0]
    assert f"\nversion: {version}\ndate-released: {date}\n" in (ROOT / "CITATION.cff").read_text()
    assert PROJECT["dynamic"] == ["version"]


def others() -> list[str]:
    """Interpreters of the other Pythons that are supported, of those that are here."""
    found = [shutil.which(f"python{minor}") for minor in MINORS]
    managed = Path.home() / ".pyenv" / "versions"
    found += [str(path) for minor in MINORS for path in managed.glob(f"{minor}.*/bin/python3")]
    here = f"{sys.version_info.major}.{sys.version_info.minor}"
    asked = {path: told(path) for path in found if path}
    return [*{minor: path for path, minor in asked.items() if minor in MINORS and minor != here}.values()]


def told(python: str) -> str:
    code = "import sys, ensurepip; print('%d.%d' % sys.version_info[:2])"
    return subprocess.run([python, "-c", code], capture_output=True, text=True).stdout.strip()


def learns(python: str, wheel: zipfile.ZipFile, folder: Path) -> None:
    """Install the wheel by pip alone into an empty environment, and learn there, far from the sources."""
    alone = {name: value for name, value in os.environ.items() if not name.startswith(("PYTHON", "XLA_FLAGS"))}
    bare = folder / "bare" / ("Scripts" if os.name == "nt" else "bin")

    def run(*command: object) -> str:
        done = subprocess.run([*map(str, command)], cwd=folder, env=alone, capture_output=True, text=True)
        assert done.returncode == 0, done.stdout + done.stderr
        return done.stdout

    run(python, "-m", "venv", bare.parent)
    run(bare / "pip", "install", "--quiet", "--no-compile", wheel.filename)
    small = ["model.hidden=[8]", "policy.hidden=[8]", "fit.steps=3", "search.steps=4", "eval_episodes=1"]
    said = run(bare / "pegasus-train", "task=cartpole", "preset=cartpole_network", "trials=1", "out=demo", *small)
    assert "done: demo" in said
    assert f"pegasus-jax {Path(str(wheel.filename)).name.split('-')[1]}\n" == run(bare / "pegasus-eval", "--version")


@pytest.mark.slow
def test_the_wheel_learns_in_an_empty_environment(wheel: zipfile.ZipFile, tmp_path: Path) -> None:
    learns(sys.executable, wheel, tmp_path)


@pytest.mark.campaign
@pytest.mark.parametrize("words", ["uv tool run --from", "pipx run --spec"])
def test_the_wheel_runs_without_being_installed(words: str, wheel: zipfile.ZipFile, tmp_path: Path) -> None:
    program, *rest = words.split()
    if not find_spec(program):
        pytest.skip(f"no {program} is here")
    alone = {name: value for name, value in os.environ.items() if not name.startswith(("PYTHON", "XLA_FLAGS"))}
    command = [sys.executable, "-m", program, *rest, wheel.filename, "pegasus-train", "--version", "--verbose"]
    done = subprocess.run([*map(str, command)], cwd=tmp_path, env=alone, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert re.search(r"^devices +cpu", done.stdout, re.MULTILINE)


@pytest.mark.campaign
def test_the_wheel_learns_with_the_other_pythons(wheel: zipfile.ZipFile, tmp_path: Path) -> None:
    found = others()
    if not found:
        pytest.skip("no other Python is here")
    for index, python in enumerate(found):
        (tmp_path / str(index)).mkdir()
        learns(python, wheel, tmp_path / str(index))


# What GitHub reads


def workflow(name: str) -> dict[str, Any]:
    return yaml.safe_load((ROOT / ".github" / "workflows" / f"{name}.yml").read_text())


@pytest.mark.parametrize("name", ["ci", "release"])
def test_a_workflow_has_its_form_and_runs_what_there_is(name: str) -> None:
    found = workflow(name)
    assert found["permissions"] == {"contents": "read"}
    for job in found["jobs"].values():
        assert {*job.get("needs", "").split()} <= {*found["jobs"]}
        for step in job["steps"]:
            assert ("run" in step) != ("uses" in step)
            # A tag can be moved to other code, which would run with the right to publish; a commit cannot.
            assert re.fullmatch(r"[\w-]+/[\w-]+@[0-9a-f]{40}", step.get("uses", f"a/b@{'0' * 40}"))
            if "checkout" in step.get("uses", ""):
                assert step["with"]["persist-credentials"] is False
            for line in step.get("run", "").splitlines():
                for command, words in re.findall(r"\b(pegasus-\w+)\"? (.*)", line):
                    assert command in PROJECT["scripts"]
                    if command == "pegasus-train" and "--" not in words:
                        understood(words.split())
    tests = re.findall(r"tests/\w+\.py|\.ci/run", str(found))
    assert all((ROOT / path).is_file() for path in tests)


FORMS = {
    "github-workflows": "workflows/*.yml",
    "github-issue-forms": "ISSUE_TEMPLATE/[!c]*.yml",
    "github-issue-config": "ISSUE_TEMPLATE/config.yml",
    "dependabot": "dependabot.yml",
    "citation-file-format": "../CITATION.cff",
}


@pytest.mark.parametrize("schema", FORMS)
def test_what_github_reads_has_the_published_form(schema: str) -> None:
    """The schemas come with the package: no network."""
    paths = [str(path) for path in (ROOT / ".github").glob(FORMS[schema])]
    words = [sys.executable, "-m", "check_jsonschema", "--builtin-schema", f"vendor.{schema}", *paths]
    done = subprocess.run(words, capture_output=True, text=True)
    assert paths
    assert done.returncode == 0, done.stdout


def test_ci_has_three_pythons_and_three_systems_and_a_tag_releases() -> None:
    ci, release = workflow("ci"), workflow("release")
    matrix = ci["jobs"]["installed"]["strategy"]["matrix"]
    assert matrix["python"] == MINORS
    assert len(matrix["os"]) == 3
    systems = [line for line in PROJECT["classifiers"] if line.startswith("Operating System")]
    assert len(systems) == 3
    assert release[True] == {"push": {"tags": ["v*"]}}  # `on` is a truth value in YAML
    assert [name for name, job in release["jobs"].items() if "id-token" in job.get("permissions", {})] == ["publish"]


def test_issues_ask_for_the_versions_and_containers_are_of_files_that_are_there() -> None:
    templates = [path for path in (ROOT / ".github" / "ISSUE_TEMPLATE").iterdir() if path.stem != "config"]
    assert len(templates) == 2
    for path in templates:
        asked = [field["attributes"]["label"] for field in yaml.safe_load(path.read_text())["body"]]
        assert "Output of `pegasus-train --version --verbose`" in asked
    container = json.loads((ROOT / ".devcontainer" / "devcontainer.json").read_text())
    assert "make setup" in container["postCreateCommand"]
    system = r"apt-get install -y (?:--no-install-recommends )?([\w -]+?)(?: &&|$)"
    (of_ci,) = re.findall(system, (ROOT / ".github" / "workflows" / "ci.yml").read_text(), re.MULTILINE)
    assert re.findall(system, container["postCreateCommand"]) == [of_ci]
    assert re.findall(r'^CMD \["(\S+)"', (ROOT / "Dockerfile").read_text(), re.MULTILINE) == ["pegasus-train"]
    cited = {*re.findall(r"@(\w+20\d\d|\w+18)", (ROOT / "paper.md").read_text())}
    assert cited == {*re.findall(r"^@\w+\{(\w+),", (ROOT / "paper.bib").read_text(), re.MULTILINE)}


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
