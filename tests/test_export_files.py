"""Each exported file where it is to run: without JAX, on a C compiler's strictest terms, in a runtime, in JAX alone."""

import json
import subprocess
import sys
from pathlib import Path
from shutil import which

import numpy as np
import pytest

import pegasus_jax
from folders import a_run
from test_export import learned_by, needs_cc

X = [0.1, -0.2, 0.3, 3.0]


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return a_run(tmp_path_factory.mktemp("runs") / "arm", trials=2)


@pytest.fixture(scope="module")
def u(run: Path) -> np.ndarray:
    """What the policy does at X."""
    return pegasus_jax.controller(run)(X)


def alone(program: str, *blocked: str, folder: Path) -> str:
    """What a program prints in a process of its own, in which these packages cannot be imported."""
    block = "".join(f"sys.modules[{name!r}] = None\n" for name in blocked)
    words = [sys.executable, "-c", f"import sys\nsys.path.insert(0, {str(folder)!r})\n{block}{program}"]
    return subprocess.run(words, capture_output=True, text=True, check=True).stdout


def test_a_robot_without_jax_drives_by_the_module(run: Path, u: np.ndarray, tmp_path: Path) -> None:
    pegasus_jax.export(run, out=tmp_path / "arm.py")
    program = f"""
import arm
control = arm.Controller()
control.reset()
u = control({X})
assert (u == arm.act({X})).all() and u.dtype == "float32"
assert len(arm.OBSERVATION) == 4 and arm.CONTROL == ("force [N]",) and arm.PERIOD == 0.1
for wrong in ([1.0], [0, 0, 0, float("nan")]):
    try:
        control(wrong)
    except ValueError as error:
        assert "4 finite numbers" in str(error)
    else:
        raise AssertionError(wrong)
assert not [name for name in sys.modules if name.startswith(("jax", "pegasus", "flax")) and sys.modules[name]]
print(float(u[0]))
"""
    found = float(alone(program, "jax", "pegasus_jax", "pegasus_envs", folder=tmp_path))
    assert found == pytest.approx(u[0], abs=2e-5)


STRICT = ["-Wall", "-Wextra", "-Wpedantic", "-Wshadow", "-Wconversion", "-Wdouble-promotion", "-Werror"]


@needs_cc
def test_two_headers_are_one_program_without_a_warning(run: Path, u: np.ndarray, tmp_path: Path) -> None:
    """And a reading that is no number is answered by 1, with the control left as it was."""
    for name, trial in (("one", 1), ("two", 2)):
        text = pegasus_jax.export(run, format="c", trial=trial, out=tmp_path / f"{name}.h").read_text()
        assert "alloc" not in text.replace("without allocation", "").replace("no allocation", "")
        assert [line for line in text.splitlines() if line.startswith("#include")] == ["#include <math.h>"]
    (tmp_path / "main.c").write_text(f"""
#include <stdio.h>
#include "one.h"
#include "two.h"
int main(void) {{
    float x[ONE_OBSERVATIONS] = {{{", ".join(f"{x}f" for x in X)}}}, u[2] = {{7, 7}};
    one_reset();
    two_reset();
    if (one_act(x, u) || two_act(x, u + 1)) return 1;
    printf("%.9g %.9g", (double)u[0], (double)u[1]);
    x[2] = NAN;
    u[0] = 7;
    printf(" %d %g", one_act(x, u), (double)u[0]);
    return 0;
}}
""")
    program = tmp_path / "main"
    subprocess.run(["cc", "-std=c99", *STRICT, f"{program}.c", "-o", str(program), "-lm"], check=True)
    first, second, code, kept = subprocess.run(
        [str(program)], capture_output=True, text=True, check=True
    ).stdout.split()
    expected = [float(pegasus_jax.controller(run, trial=trial)([np.float32(x) for x in X])[0]) for trial in (1, 2)]
    assert [float(first), float(second)] == pytest.approx(expected, abs=2e-5)
    assert (code, kept) == ("1", "7")
    assert abs(expected[0] - expected[1]) > 1e-3


@needs_cc
@pytest.mark.parametrize("name", ["linear of circles", "rbf, double"])
def test_a_header_of_another_policy_has_no_warning_either(name: str, tmp_path: Path) -> None:
    text = pegasus_jax.export(learned_by(tmp_path, name), format="c", out=tmp_path / "arm.h").read_text()
    real = "double x" if "double x[" in text else "float x"
    (tmp_path / "main.c").write_text(f"""
#include "arm.h"
int main(void) {{ {real}[ARM_OBSERVATIONS] = {{0}}, u[ARM_CONTROLS]; arm_reset(); return arm_act(x, u); }}
""")
    words = ["cc", "-std=c99", *STRICT, str(tmp_path / "main.c"), "-o", str(tmp_path / "main"), "-lm"]
    subprocess.run(words, check=True)
    subprocess.run([str(tmp_path / "main")], check=True)
    if which("c++"):  # firmware is often in C++
        subprocess.run(["c++", "-Wall", "-Wextra", "-Werror", "-fsyntax-only", str(tmp_path / "main.c")], check=True)


def test_a_runtime_of_onnx_takes_a_batch(run: Path, u: np.ndarray, tmp_path: Path) -> None:
    file = pegasus_jax.export(run, format="onnx", out=tmp_path / "arm.onnx")
    program = f"""
import numpy, onnxruntime
session = onnxruntime.InferenceSession({str(file)!r}, providers=["CPUExecutionProvider"])
(given,), (sent,) = session.get_inputs(), session.get_outputs()
assert (given.name, given.shape, given.type) == ("observation", ["batch", 4], "tensor(float)"), given
assert (sent.name, sent.shape) == ("control", ["batch", 1])
u = session.run(None, {{"observation": numpy.array([{X}] * 3 + [[0, 0, 0, 0]], "float32")}})[0]
assert u.shape == (4, 1) and u[0] == u[2] != u[3]
print(float(u[0, 0]))
"""
    found = float(alone(program, "jax", "pegasus_jax", folder=tmp_path))
    assert found == pytest.approx(u[0], abs=2e-5)


def test_onnx_knows_the_angle_of_a_pair_without_an_arctangent(tmp_path: Path) -> None:
    """In every quadrant, on the axes, of readings far from the circle, and of two zeros."""
    import onnxruntime

    run = learned_by(tmp_path, "mlp of circles")
    session = onnxruntime.InferenceSession(pegasus_jax.export(run, format="onnx", out=tmp_path / "a.onnx").read_bytes())
    control = pegasus_jax.controller(run)
    pairs = [(0, 0), (1, 0), (-1, 0), (0, 1), (0, -1), (0.6, -0.8), (-3, 4), (1e-30, -1e-30), (1e30, 2e30)]
    x = np.array([[0.1, sine, cosine, 0.5, -0.2] for cosine, sine in pairs], np.float32)
    found = session.run(None, {"observation": x})[0]
    np.testing.assert_allclose(found, np.stack([control(row) for row in x]), atol=1e-5)
    assert len({*found[:, 0].tolist()}) == len(pairs) - 1  # but (0, 0) and (1, 0), all of them differ


@pytest.mark.parametrize("wide", ["false", "true"])
def test_jax_alone_calls_the_stablehlo(wide: str, tmp_path: Path) -> None:
    run = a_run(tmp_path / "run", trials=1, x64=wide)
    file = pegasus_jax.export(run, format="stablehlo", out=tmp_path / "arm.stablehlo")
    program = f"""
import jax
from pathlib import Path
numbers = {json.loads(Path(f"{file}.json").read_text())["numbers"]!r}
jax.config.update("jax_enable_x64", numbers == "float64")
act = jax.export.deserialize(bytearray(Path({str(file)!r}).read_bytes()))
assert act.in_avals[0].shape == (4,) and act.out_avals[0].dtype == numbers
print(float(act.call(jax.numpy.array({X}))[0]))
"""
    found = float(alone(program, "pegasus_jax", "pegasus_envs", "flax", folder=tmp_path))
    assert found == pytest.approx(pegasus_jax.controller(run)(X)[0], abs=2e-5 if wide == "false" else 1e-12)
