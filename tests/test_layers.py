"""The layers of docs/design.md: imports point strictly downwards, by folder, and within a folder they make no cycle.

A new folder or top-level file: give it a layer in LAYERS.
"""

from __future__ import annotations

import ast
import re
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]

# Folders end in a dot. What one layer holds side by side does not import each other.
LAYERS = {
    0: "types checks interrupt shell",
    1: "config_models shapes sharding task vectorized math.",
    2: "config_plant config_policies memory",
    3: "config models. imagine. episode",
    4: "presets policies. learn. config_used",
    5: "tasks. pilco. experiment",
    6: "assembly. logs.",
    7: "runs.",
    8: "viz. exports. report.",
    9: "start",
    10: "cli. deploy __init__",
}
APPLICATION = 7  # the first layer that knows of files, terminals and people

# Foreign packages that only some layers may import.
APPLICATION_ONLY = {"omegaconf", "hydra", "rich", "matplotlib", "tensorboardX"}
ENVIRONMENTS, ENVIRONMENTS_IMPORTERS = "pegasus_envs", "tasks."


def folder_of(module: str) -> str:
    """The name in LAYERS of a module given as its dotted name inside the package: "config", "models.bnn"."""
    head, dot, _ = module.partition(".")
    return head + dot


def layer_of(module: str) -> int | None:
    """Layer of a module, or None where its folder has none."""
    return next((layer for layer, names in LAYERS.items() if folder_of(module) in names.split()), None)


def module_name(path: Path, package: Path) -> str:
    """Dotted name inside the package; a subpackage's __init__ is "dynamics.__init__", so that it shares its layer."""
    return ".".join(path.relative_to(package).with_suffix("").parts)


def imports(path: Path, package: Path) -> list[tuple[int, str]]:
    """(line, absolute dotted name) of every import anywhere in the file, `from a import b` as "a.b"."""
    parent = [package.name, *path.relative_to(package).parent.parts]
    found = []
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"), str(path))):
        if isinstance(node, ast.Import):
            found += [(node.lineno, alias.name) for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            base = parent[: len(parent) - node.level + 1] if node.level else []
            prefix = ".".join([*base, *([node.module] if node.module else [])])
            found += [(node.lineno, f"{prefix}.{alias.name}") for alias in node.names]
    return sorted(found)


def resolve(name: str, modules: set[str]) -> str:
    """The module of this package that the import of `name` (package prefix removed) executes last."""
    parts = name.split(".") if name else []
    while parts:
        for candidate in (".".join(parts), ".".join([*parts, "__init__"])):
            if candidate in modules:
                return candidate
        parts.pop()
    return "__init__"


def cycles(arrows: dict[str, set[str]]) -> list[str]:
    """One description for each strand of imports that comes back to where it began."""
    found: list[str] = []
    done: set[str] = set()

    def visit(module: str, trail: list[str]) -> None:
        if module in trail:
            ring = trail[trail.index(module) :]
            first = ring.index(min(ring))
            found.append(" -> ".join([*ring[first:], *ring[:first], min(ring)]))
        elif module not in done:
            for target in sorted(arrows.get(module, ())):
                visit(target, [*trail, module])
            done.add(module)

    for module in sorted(arrows):
        visit(module, [])
    return found


def violations(package: Path) -> list[str]:
    """What is wrong with the imports of the package in this folder, one line each; empty when all is well."""
    files = {module_name(path, package): path for path in sorted(package.rglob("*.py"))}
    problems: list[str] = []
    arrows: dict[str, set[str]] = {}
    for module, path in files.items():
        here = layer_of(module)
        if here is None:
            problems.append(f"{path.relative_to(package)}: unknown: give {folder_of(module)} a layer in test_layers.py")
            continue
        for line, name in imports(path, package):
            where = f"{path.relative_to(package)}:{line}"
            head, _, rest = name.partition(".")
            if head == ENVIRONMENTS and folder_of(module) != ENVIRONMENTS_IMPORTERS:
                problems.append(f"{where}: only {ENVIRONMENTS_IMPORTERS} may import {ENVIRONMENTS}")
            if head in APPLICATION_ONLY and here < APPLICATION:
                problems.append(f"{where}: {module} (layer {here}) imports {head}: only layer {APPLICATION} and above")
            if head != package.name:
                continue
            target = resolve(rest, set(files))
            there = layer_of(target)
            if there is None or target == module:
                continue  # an unknown file is reported on its own; `from . import x` in __init__ may name an attribute
            arrows.setdefault(module, set()).add(target)
            if not (there < here or folder_of(module) == folder_of(target)):
                problems.append(f"{where}: {module} (layer {here}) imports {target} (layer {there}): not downwards")
    return problems + [f"import cycle: {cycle}" for cycle in cycles(arrows)]


def test_imports_point_downwards() -> None:
    assert not violations(ROOT / "src" / "pegasus_jax")


def test_environments_know_nothing_of_the_library() -> None:
    package = ROOT / "envs" / "pegasus_envs"
    found = [
        f"{path.relative_to(package)}:{line} imports {name}"
        for path in sorted(package.rglob("*.py"))
        for line, name in imports(path, package)
        if name.split(".")[0] == "pegasus_jax"
    ]
    assert not found


# The checker itself, on a small package with something planted in it.

CLEAN = {
    "__init__.py": "from pegasus_jax.assembly.experiments import build\nfrom pegasus_jax.imagine import rollout\n",
    "types.py": "import jax\n",
    "math/__init__.py": "",
    "math/angles.py": "from pegasus_jax.types import A\n",
    "imagine/__init__.py": "",
    "imagine/costs.py": "from ..math.angles import wrap\nfrom .. import types\n",
    "imagine/rollout.py": "from pegasus_jax import types\nfrom .costs import saturating\n",
    "learn/__init__.py": "",
    "learn/search.py": "import pegasus_jax.imagine.rollout as r\n",
    "models/__init__.py": "from .bnn import bnn\n",
    "models/bnn.py": "from ..math.angles import wrap\n",
    "tasks/__init__.py": "import pegasus_envs\n",
    "assembly/experiments.py": "from pegasus_jax.models import bnn\nfrom pegasus_jax import tasks\n",
    "runs/__init__.py": "",
    "runs/store.py": "def load():\n    from omegaconf import OmegaConf\n",
    "viz/__init__.py": "",
    "viz/curve.py": "import matplotlib.pyplot as plt\nfrom pegasus_jax.runs import store\n",
    "cli/__init__.py": "",
    "cli/main.py": "def train():\n    from pegasus_jax.viz import curve\n",
}


def plant(folder: Path, changes: dict[str, str]) -> Path:
    package = folder / "pegasus_jax"
    for name, text in {**CLEAN, **changes}.items():
        (package / name).parent.mkdir(parents=True, exist_ok=True)
        (package / name).write_text(text)
    return package


def test_checker_accepts_a_clean_package(tmp_path: Path) -> None:
    assert violations(plant(tmp_path, {})) == []


ROLLOUT = "imagine.rollout (layer 3) imports"


@pytest.mark.parametrize(
    ("file", "text", "complaint"),
    [
        ("imagine/rollout.py", "from pegasus_jax.learn.search import a\n", f"{ROLLOUT} learn.search (layer 4)"),
        ("imagine/rollout.py", "from ..learn.search import a\n", f"{ROLLOUT} learn.search (layer 4)"),
        ("imagine/rollout.py", "def f():\n    import pegasus_jax.learn.search\n", f"rollout.py:2: {ROLLOUT} learn"),
        ("imagine/rollout.py", "from pegasus_jax import gradient_search\n", f"{ROLLOUT} __init__ (layer 10)"),
        ("imagine/rollout.py", "if TYPE_CHECKING:\n    from ..models.bnn import b\n", f"{ROLLOUT} models.bnn"),
        (
            "math/angles.py",
            "from pegasus_jax.models import bnn\n",
            "math.angles (layer 1) imports models.bnn (layer 3)",
        ),
        ("math/angles.py", "import pegasus_jax.models\n", "math.angles (layer 1) imports models.__init__ (layer 3)"),
        ("models/bnn.py", "from ..tasks import cartpole\n", "models.bnn (layer 3) imports tasks.__init__ (layer 5)"),
        ("imagine/costs.py", "from .rollout import f\n", "cycle: imagine.costs -> imagine.rollout -> imagine.costs"),
        ("runs/store.py", "from pegasus_jax.viz import curve\n", "import cycle: runs.store -> viz.curve -> runs.store"),
        ("assembly/experiments.py", "from pegasus_envs import cartpole\n", "only tasks. may import pegasus_envs"),
        (
            "assembly/experiments.py",
            "from omegaconf import OmegaConf\n",
            "assembly.experiments (layer 6) imports omegaconf",
        ),
        ("types.py", "import rich.progress\n", "types (layer 0) imports rich"),
        ("helpers.py", "", "helpers.py: unknown: give helpers a layer in test_layers.py"),
        ("utils/misc.py", "", "utils/misc.py: unknown: give utils. a layer in test_layers.py"),
    ],
)
def test_checker_catches(tmp_path: Path, file: str, text: str, complaint: str) -> None:
    assert any(complaint in problem for problem in violations(plant(tmp_path, {file: text})))


# Functions of the method are short enough to be read at once.

LONGEST, MOST_PARAMETERS = 60, 8


def too_large(source: str) -> list[str]:
    """Functions of more lines or parameters than a reader holds in mind."""
    found = []
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.FunctionDef):
            a, lines = node.args, (node.end_lineno or node.lineno) - node.lineno + 1
            count = len([*a.posonlyargs, *a.args, *a.kwonlyargs])
            if lines > LONGEST or count > MOST_PARAMETERS:
                found.append(f"{node.name}: {lines} lines, {count} parameters")
    return found


@pytest.mark.parametrize("folder", ["learn", "imagine"])
def test_functions_of_the_method_are_small(folder: str) -> None:
    files = sorted((ROOT / "src" / "pegasus_jax" / folder).glob("*.py"))
    assert not [f"{path.name}: {what}" for path in files for what in too_large(path.read_text(encoding="utf-8"))]


def test_a_large_function_is_found() -> None:
    assert too_large("def f(a, b, c, d, e, *, g, h, i, j): pass") == ["f: 1 lines, 9 parameters"]
    assert too_large("def f():\n" + "    x = 1\n" * LONGEST) == [f"f: {LONGEST + 1} lines, 0 parameters"]
    assert not too_large("def f():\n" + "    x = 1\n" * (LONGEST - 1))


# Outside of the folders that choose pieces, values and types decide, never whose function something is or its name.

CHOOSERS = ("assembly", "tasks")


def decided_by_identity(source: str) -> list[str]:
    """What decides by identity, by `hasattr`, or by a task's name: `is` is for None, True and False."""
    found = []
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Compare):
            sides = [node.left, *node.comparators]
            of_constant = any(isinstance(side, ast.Constant) and side.value in (None, True, False) for side in sides)
            identical = any(isinstance(operator, ast.Is | ast.IsNot) for operator in node.ops) and not of_constant
            named = any(map(_task, sides)) and any(map(_names, sides))
            if identical or named:
                found.append(ast.unparse(node))
        elif isinstance(node, ast.Call):
            asks = isinstance(node.func, ast.Name) and node.func.id in ("hasattr", "getattr")
            has = asks and (node.func.id == "hasattr" or len(node.args) == 3)
            text = isinstance(node.func, ast.Attribute) and node.func.attr in ("startswith", "endswith")
            if has or (text and _task(node.func.value)):
                found.append(ast.unparse(node))
        elif isinstance(node, ast.Match) and _task(node.subject):
            found.append(f"match {ast.unparse(node.subject)}")
    return found


def _task(node: ast.AST) -> bool:
    """Whether this is the name of a task: `config.task`, `task`, `task.name`, `run.task.name`."""
    return bool(re.search(r"(^|\.)task(\.name)?$", ast.unparse(node)))


def _names(node: ast.AST) -> bool:
    """Whether this is a word in a program, a constant for one, or some of them."""
    if isinstance(node, ast.Tuple | ast.List | ast.Set):
        return any(map(_names, node.elts))
    word = isinstance(node, ast.Constant) and isinstance(node.value, str)
    constant = ast.unparse(node).rpartition(".")[2] if isinstance(node, ast.Name | ast.Attribute) else ""
    return word or constant.isupper()


def test_values_and_types_decide() -> None:
    package = ROOT / "src" / "pegasus_jax"
    files = [path for path in package.rglob("*.py") if path.relative_to(package).parts[0] not in CHOOSERS]
    assert len(files) > 60
    found = {str(path.relative_to(package)): decided_by_identity(path.read_text(encoding="utf-8")) for path in files}
    assert {name: what for name, what in found.items() if what} == {}


@pytest.mark.parametrize(
    "source",
    [
        "f if given is not apply else g",
        "if hasattr(plant, 'substeps'): pass",
        "getattr(plant, 'substeps', None)",
        "if config.task == 'gym': pass",
        "if config.task in (tasks.GYM, MJCF): pass",
        "if 'cartpole' != task.name: pass",
        "run.task.name.startswith('swimmer_')",
        "match config.task:\n    case _: pass",
    ],
)
def test_what_decides_by_identity_is_found(source: str) -> None:
    assert decided_by_identity(source)


@pytest.mark.parametrize(
    "source",
    [
        "if x is None: pass",
        "row.get('kept') is False",
        "one.task == other.task",
        "isinstance(x, Y)",
        "getattr(x, name)",
    ],
)
def test_what_decides_by_value_or_type_is_not(source: str) -> None:
    assert not decided_by_identity(source)
