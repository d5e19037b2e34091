"""The layers of docs/design.md: imports point strictly downwards, and every file has a layer.

A new module: give it a layer in LAYERS. A new arrow within a layer: think first, then list it in SIBLINGS.
"""

from __future__ import annotations

import ast
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]

# A name ending in a dot is a package: the layer of everything in it.
LAYERS = {
    0: "types checks config config_models variants defaults interrupt",
    1: "angles mesh quantile dropout whiten moments moments_kernel gaussian cost course dataset scenarios rollout"
    " episode calibration user_code",
    2: "network noisy mechanics mechanics_kernel kernel fit lbfgs search population pilco cost_check",
    3: "dynamics. policy. trial",
    4: "tasks",
    5: "build",
    6: "board cache check checkpoint deploy facts files machine record report. restore cli program progress settings"
    " sweep train study __main__ __init__",
}
TOP = max(LAYERS)  # the layer that is an application: here modules may import each other, without cycles

# (importer, imported), both of one layer below TOP.
SIBLINGS: set[tuple[str, str]] = {
    ("config_models", "checks"),
    ("config", "config_models"),  # the settings of the models are its
    ("config", "checks"),  # a setting is checked when it is made
    ("defaults", "config"),  # what a task changes in them; a folder's name is made of them
    ("variants", "config"),  # a variant is made of settings
    ("dropout", "quantile"),  # uniform draws, and what makes a truncated normal of them
    ("dataset", "angles"),  # targets are differences of states, and differences of angles wrap
    ("calibration", "angles"),  # an error of 359 degrees is one of 1
    ("moments", "mesh"),  # whether particles are whole on one GPU
    ("moments", "moments_kernel"),  # and are then matched by a kernel
    ("gaussian", "moments"),  # one Cholesky factor for a few dimensions
    ("cost", "gaussian"),  # the expected cost of a Gaussian state
    ("cost", "moments"),  # of the Gaussian with the particles' mean and covariance
    ("scenarios", "mesh"),  # where the particles that it draws lie
    ("scenarios", "moments"),  # the noise of moment matching is drawn standardised
    ("pilco", "lbfgs"),  # one L-BFGS for model and policy
    ("pilco", "search"),  # and one report of how a search went
    ("lbfgs", "fit"),  # what every fit reports
    ("policy.external", "policy.squash"),  # every controller saturates the same ways
    *((f"policy.{kind}", "policy.scaled") for kind in ("mlp", "linear", "rbf")),  # large inputs, the same way
    ("noisy", "network"),  # the one network, with noise on its units
    ("mechanics", "network"),  # a mechanism's energies are that network
    ("mechanics_kernel", "mechanics"),  # the same equations, where they are compiled by hand
    ("search", "fit"),  # one guarded optimiser, one count of skipped updates
}

# Foreign packages that only some layers may import.
APPLICATION_ONLY = {"omegaconf", "hydra", "rich", "matplotlib", "tensorboardX"}  # TOP
ENVIRONMENTS, ENVIRONMENTS_IMPORTER = "pegasus_envs", "tasks"


def layer_of(module: str) -> int | None:
    """Layer of a module given as its dotted name inside the package: "fit", "dynamics.bnn", "__init__"."""
    head, dot, _ = module.partition(".")
    for layer, names in LAYERS.items():
        if (head + "." if dot else head) in names.split():
            return layer
    return None


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


def violations(package: Path, siblings: set[tuple[str, str]] = SIBLINGS) -> list[str]:
    """What is wrong with the imports of the package in this folder, one line each; empty when all is well."""
    files = {module_name(path, package): path for path in sorted(package.rglob("*.py"))}
    problems: list[str] = []
    arrows: dict[str, set[str]] = {}
    for module, path in files.items():
        here = layer_of(module)
        if here is None:
            problems.append(f"{path.relative_to(package)}: unknown file: give it a layer in tests/test_layers.py")
            continue
        for line, name in imports(path, package):
            where = f"{path.relative_to(package)}:{line}"
            head, _, rest = name.partition(".")
            if head == ENVIRONMENTS and module != ENVIRONMENTS_IMPORTER:
                problems.append(f"{where}: only {ENVIRONMENTS_IMPORTER} may import {ENVIRONMENTS}")
            if head in APPLICATION_ONLY and here < TOP:
                problems.append(f"{where}: {module} (layer {here}) imports {head}: only layer {TOP} may")
            if head != package.name:
                continue
            target = resolve(rest, set(files))
            there = layer_of(target)
            if there is None or target == module:
                continue  # an unknown file is reported on its own; `from . import x` in __init__ may name an attribute
            arrows.setdefault(module, set()).add(target)
            of_its_own = module.endswith(".__init__") and target.startswith(module.removesuffix("__init__"))
            sideways = here == there and (here == TOP or of_its_own or (module, target) in siblings)
            if not (there < here or sideways):
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


def test_allowed_siblings_are_siblings_and_in_use() -> None:
    package = ROOT / "src" / "pegasus_jax"
    files = {module_name(path, package): path for path in package.rglob("*.py")}
    for importer, imported in SIBLINGS:
        assert layer_of(importer) == layer_of(imported) != TOP
        if importer in files:
            names = [name.partition(".")[2] for _, name in imports(files[importer], package)]
            assert imported in {resolve(name, set(files)) for name in names}, f"{importer} -> {imported} is not needed"


# The checker itself, on a small package with something planted in it.

ALLOWED = {("cost", "moments")}
CLEAN = {
    "__init__.py": "from pegasus_jax.build import build\nfrom pegasus_jax.rollout import rollout\n",
    "types.py": "import jax\n",
    "moments.py": "from pegasus_jax.types import A\n",
    "cost.py": "from .moments import expectation\nfrom . import types\n",
    "rollout.py": "from pegasus_jax import types\n",
    "search.py": "import pegasus_jax.rollout as r\n",
    "dynamics/__init__.py": "from .bnn import bnn\n",
    "dynamics/bnn.py": "from ..moments import match\n",
    "dynamics/gp.py": "",
    "tasks.py": "import pegasus_envs\n",
    "build.py": "from pegasus_jax.dynamics import bnn\nfrom pegasus_jax import tasks\n",
    "report/__init__.py": "",
    "report/curve.py": "import matplotlib.pyplot as plt\nfrom pegasus_jax import record\n",
    "record.py": "",
    "cli.py": "def train():\n    from omegaconf import OmegaConf\n    from pegasus_jax.report import curve\n",
}


def plant(folder: Path, changes: dict[str, str]) -> Path:
    package = folder / "pegasus_jax"
    for name, text in {**CLEAN, **changes}.items():
        (package / name).parent.mkdir(parents=True, exist_ok=True)
        (package / name).write_text(text)
    return package


def test_checker_accepts_a_clean_package(tmp_path: Path) -> None:
    assert violations(plant(tmp_path, {}), ALLOWED) == []


@pytest.mark.parametrize(
    ("file", "text", "complaint"),
    [
        ("rollout.py", "from pegasus_jax.search import optimise\n", "rollout (layer 1) imports search (layer 2)"),
        ("rollout.py", "from .search import optimise\n", "rollout (layer 1) imports search (layer 2)"),
        ("rollout.py", "def f():\n    import pegasus_jax.search\n", "rollout.py:2: rollout (layer 1) imports search"),
        ("rollout.py", "from pegasus_jax import optimise\n", "rollout (layer 1) imports __init__ (layer 6)"),
        ("rollout.py", "if TYPE_CHECKING:\n    from .cost import saturating\n", "rollout (layer 1) imports cost"),
        ("search.py", "from pegasus_jax.dynamics import bnn\n", "search (layer 2) imports dynamics.bnn (layer 3)"),
        ("search.py", "import pegasus_jax.dynamics\n", "search (layer 2) imports dynamics.__init__ (layer 3)"),
        ("dynamics/gp.py", "from . import bnn\n", "dynamics.gp (layer 3) imports dynamics.bnn (layer 3)"),
        ("dynamics/gp.py", "from ..tasks import cartpole\n", "dynamics.gp (layer 3) imports tasks (layer 4)"),
        ("moments.py", "from .cost import saturating\n", "import cycle: cost -> moments -> cost"),
        ("record.py", "from pegasus_jax.report import curve\n", "import cycle: record -> report.curve -> record"),
        ("build.py", "from pegasus_envs import cartpole\n", "only tasks may import pegasus_envs"),
        ("build.py", "from omegaconf import OmegaConf\n", "build (layer 5) imports omegaconf"),
        ("types.py", "import rich.progress\n", "types (layer 0) imports rich"),
        ("helpers.py", "", "helpers.py: unknown file: give it a layer in tests/test_layers.py"),
        ("utils/misc.py", "", "utils/misc.py: unknown file: give it a layer in tests/test_layers.py"),
    ],
)
def test_checker_catches(tmp_path: Path, file: str, text: str, complaint: str) -> None:
    assert any(complaint in problem for problem in violations(plant(tmp_path, {file: text}), ALLOWED))
