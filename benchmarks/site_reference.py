"""The API reference of the documentation site, from the source: a page for each group of public names.

A name has its docstring (mkdocstrings), the fields of a tuple with what the comments beside them say, those of settings
with their help and defaults, and the part of examples/api that uses it.
"""

import ast
import re
from functools import cache
from pathlib import Path
from typing import Any

import pegasus_jax

ROOT = Path(__file__).parents[1]

# A page of the API reference: its title and the modules whose names it has; families of functions have one each.
GROUPS = {
    "A run": ("config", "start", "logs.read", "runs.controller", "exports.write", "math.delays", "checks"),
    "An experiment": ("assembly.experiments", "assembly.pieces", "experiment", "episode", "task", "vectorized"),
    "Imagination": ("imagine.scenarios", "imagine.rollout", "imagine.objective", "imagine.limits"),
    "Fit and search": ("learn.fit", "learn.gradient", "learn.search", "learn.rounds", "learn.schedule", "learn.visits"),
    "Models": ("models.bnn", "models.ensemble", "models.lagrangian", "pilco.gp", "pilco.ssgp"),
    "Policies": ("policies.mlp", "policies.linear", "policies.wrap", "pilco.rbf"),
    "Types": ("types",),
}
SETTINGS = ("config_models", "config_policies", "config_plant", "config")  # the kinds of a Config's sections
PROGRAMS = ("examples/api/pieces.py", "examples/api/runs.py")  # what the examples are parts of
LETTERS = """\
All of these are names of `pegasus_jax`. Shapes: K particles, H horizon, D state, U control, F features, N rows of data,
M rows of a minibatch, T trials, S seeds, E episodes. The examples are parts of two programs:
[models, policies, imagination, search](../repository/examples/api/pieces.py.md) and
[runs](../repository/examples/api/runs.py.md).
"""


def api_uris() -> dict[str, str]:
    """Title -> page of the API reference."""
    return {title: f"api/{title.lower().replace(' ', '_')}.md" for title in (*GROUPS, "Families")}


def api_page(title: str) -> str:
    """One page: the names of its modules, or the families of functions."""
    if title == "Families":
        parts = map(family, sorted(pegasus_jax._FAMILIES))
    else:
        modules = {name: module for module in GROUPS[title] for name in pegasus_jax._NAMES[module].split()}
        parts = (entry(module, name) for name, module in modules.items())
    return f"# {title}\n\n{LETTERS}\n{''.join(parts)}"


def family(name: str) -> str:
    """A module whose functions have one kind of task; of the settings, those of each kind."""
    module = pegasus_jax._FAMILIES[name]
    head = f"\n## {name}\n\n::: pegasus_jax.{module}\n    options: {{show_root_heading: false, show_source: false}}\n"
    if name == "config":
        kinds = [entry(part, kind, level=3) for part in SETTINGS for kind in defined(part, ast.ClassDef)]
        return "".join([head, example(name), *kinds])
    return "".join([head, example(name), *(shown(module, one, 3) for one in defined(module, ast.FunctionDef))])


def entry(module: str, name: str, level: int = 2) -> str:
    """A name: mkdocstrings' part, the fields of a tuple or of settings, and an example."""
    rows = "\n".join(map(row, fields(module, name)))
    table = f"\n| field | type | what it is |\n|---|---|---|\n{rows}\n" if rows else ""
    return shown(module, name, level) + table + (example(name) if module not in SETTINGS or level == 2 else "")


def shown(module: str, name: str, level: int) -> str:
    """What mkdocstrings makes of a name."""
    return f"\n::: pegasus_jax.{module}.{name}\n    options: {{heading_level: {level}}}\n"


def row(field: tuple[str, str, str]) -> str:
    """A line of a table. A bar is of the table and [K] [s] a link to Markdown, so what is said has neither."""
    name, kind, said = field
    for letter, code in {"&": "&amp;", "|": "&#124;", "<": "&lt;", "*": "&#42;", "[": "&#91;", "_": "&#95;"}.items():
        said = said.replace(letter, code)
    return f"| `{name}` | `{kind.replace('|', 'or')}` | {said} |"


@cache
def source(module: str) -> tuple[list[str], list[Any]]:
    """The lines of a module of the package and its statements."""
    path = ROOT / "src" / "pegasus_jax" / Path(*module.split(".")).with_suffix(".py")
    text = (path if path.exists() else path.with_suffix("") / "__init__.py").read_text()
    return text.splitlines(), ast.parse(text).body


def defined(module: str, kind: Any) -> list[str]:
    """The public classes or functions that a module defines and explains."""
    nodes = [node for node in source(module)[1] if isinstance(node, kind) and ast.get_docstring(node)]
    return [node.name for node in nodes if not node.name.startswith("_")]


def fields(module: str, name: str) -> list[tuple[str, str, str]]:
    """Name, type and meaning of each field: the comment beside or above it, or the help of a setting."""
    lines, nodes = source(module)
    (found,) = [node for node in nodes if getattr(node, "name", "") == name] or [None]
    if not isinstance(found, ast.ClassDef):
        return []
    rows = {field[0]: field for base in found.bases if isinstance(base, ast.Name) for field in fields(module, base.id)}
    for node in found.body:
        if isinstance(node, ast.AnnAssign):
            kind = ast.unparse(node.annotation).strip("'")
            rows[node.target.id] = (node.target.id, kind, help_of(node) or comment(node, lines))
    return list(rows.values())


def help_of(node: ast.AnnAssign) -> str:
    """What `setting(default, text)` says of a field, "" for another one."""
    call = node.value
    if not isinstance(call, ast.Call) or getattr(call.func, "id", "") != "setting":
        return ""
    return f"{ast.literal_eval(call.args[1])} (default {ast.unparse(call.args[0])})"


def comment(node: ast.AnnAssign, lines: list[str]) -> str:
    """What the comments above a field and beside it say."""
    beside = lines[node.end_lineno - 1][node.end_col_offset :].partition("#")[2].strip()
    above, number = [], node.lineno - 2
    while lines[number].strip().startswith("#"):
        above.insert(0, lines[number].strip().lstrip("# "))
        number -= 1
    return " ".join([*above, "" if beside.startswith("noqa") else beside]).strip()


@cache
def examples() -> dict[str, str]:
    """Name -> the lines of a program in examples/api under `# name`, or `# name, other name`."""
    found = {}
    for program in PROGRAMS:
        parts = re.split(r"^# ([\w, ]+)$\n", (ROOT / program).read_text(), flags=re.MULTILINE)[1:]
        for names, code in zip(parts[::2], parts[1::2], strict=True):
            found |= {name: code.strip() for name in names.split(", ")}
    return found


def example(name: str) -> str:
    """The part of the program that uses the name, "" for none."""
    code = examples().get(name)
    return f'\n```python title="Example"\n{code}\n```\n' if code else ""
