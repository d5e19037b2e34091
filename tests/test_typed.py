"""What a user's type checker says of a program against the package, which ships py.typed."""

import json
import subprocess
import sys
from pathlib import Path

from pegasus_jax import config

HERE = Path(sys.prefix)  # the virtual environment that has the package
SECTIONS = [
    "BNN",
    "GP",
    "SSGP",
    "Lagrangian",
    "MLP",
    "RBF",
    "Linear",
    "Fit",
    "LBFGS",
    "Search",
    "Analytic",
    "Period",
    "Explore",
    "Sensors",
]
PROGRAM = f"""
import jax
import jax.numpy as jnp
import pegasus_jax as pg
from pegasus_jax.config import {", ".join(SECTIONS)}

def cost(x: jax.Array, u: jax.Array) -> jax.Array:
    return 1 - jnp.exp(-(x[0] ** 2) - 0.1 * u[0] ** 2)

task = pg.Task(
    "cart", object(), cost, state_names=("x",), angles=(), start_mean=[1], start_std=[0.1], sensor_std=[0.0],
    control_names=("force",), control_low=[0], control_high=[1], horizon=3, dt=0.1,
)
settings = pg.Config(model=pg.config.BNN(hidden=(8,)), policy=MLP(), fit=Fit(), search=Search())
experiment = pg.compose(settings, task)
"""


def test_a_section_of_a_config_is_exported() -> None:
    assert {*config.__all__} == {"Config", *SECTIONS}


def test_a_program_is_typed(tmp_path: Path) -> None:
    """By pyright; a copy with a slip shows that it looks."""
    (tmp_path / "good.py").write_text(PROGRAM)
    (tmp_path / "bad.py").write_text(PROGRAM.replace("dt=0.1", "dt='0.1'"))
    settings = {"include": ["."], "venvPath": str(HERE.parent), "venv": HERE.name, "typeCheckingMode": "standard"}
    (tmp_path / "pyrightconfig.json").write_text(json.dumps(settings))
    program = [sys.executable, "-m", "pyright", "--outputjson", "-p", str(tmp_path)]
    done = subprocess.run(program, capture_output=True, text=True, check=False)
    found = json.loads(done.stdout)["generalDiagnostics"]
    assert {Path(one["file"]).name for one in found} == {"bad.py"}, found
    assert '"dt"' in found[0]["message"]
