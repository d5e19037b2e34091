"""A controller as one C99 header: tables and one function, without allocation and without a library but libm."""

import os
import re
import shutil
import subprocess
import tempfile
import textwrap
from pathlib import Path

import numpy as np

from pegasus_jax.checks import ConfigError
from pegasus_jax.exports.layers import Dense, Features, Kernels, Layer, Limit, Recall, Squash, Standardize, layers_of
from pegasus_jax.exports.learned import Learned, for_comment
from pegasus_jax.shell import split

HEADER = """\
/* {title}, as written by pegasus-export.
 *
 * C99 (or C++), no allocation, nothing but <math.h>: link with -lm, do not compile with -ffast-math.
 *
 *     {type} x[{observations}] = {{...}}, u[{controls}];
 *     {name}_reset();                     before every episode
 *     if ({name}_act(x, u) != 0) ...      an observation is not finite: u is as it was, stop the motors
 *
 * x  {observation}
 * u  {control}
 *
 * Written by a program: change the run, and export it again.
 */
#ifndef {guard}_H
#define {guard}_H

#include <math.h>

#define {guard}_OBSERVATIONS {observations}
#define {guard}_CONTROLS {controls}
#define {guard}_PERIOD {period!r} /* s, from one control to the next */

{arrays}

/* Forget the episode so far{forgets}. */
{memory}static inline void {name}_reset(void) {{{reset}}}

/* u [{controls}] for x [{observations}]; 0, or 1 where a number of x is not finite. */
static inline int {name}_act(const {type} *x, {type} *u) {{
{code}
    return 0;
}}

#endif
"""

CHECK = """\
#include <stdio.h>
#ifdef _WIN32
#include <fcntl.h>
#include <io.h>
#endif
#include "{name}.h"
int main(void) {{
#ifdef _WIN32
    _setmode(_fileno(stdin), _O_BINARY); _setmode(_fileno(stdout), _O_BINARY);
#endif
    {type} x[{observations}], u[{controls}];
    for (int i = 0; fread(x, sizeof *x, {observations}, stdin) == {observations}; ++i) {{
        if (i % {episode} == 0) {name}_reset();
        if ({name}_act(x, u) || fwrite(u, sizeof *u, {controls}, stdout) != {controls}) return 1;
    }}
    return 0;
}}
"""

COMPILERS = ("cc", "gcc", "clang")  # the first that is there is taken
TYPES = {"float32": ("float", "f"), "float64": ("double", "")}  # and the end of the names of its numbers and functions


def write(learned: Learned, name: str) -> bytes:
    """The header's text; its names begin with `name`. Raises ConfigError for a policy that is no list of layers."""
    layers, observations = layers_of(learned, "c"), len(learned.observation)
    real, suffix = TYPES[learned.dtype.name]
    kept = next((layer for layer in layers if isinstance(layer, Recall)), None)
    code = [f"for (int i = 0; i < {observations}; ++i) if (!isfinite(x[i])) return 1;"]
    arrays, size = {}, 0
    for number, layer in enumerate(layers):
        lines, used, size = _printed(layer, number, size)
        code += lines
        arrays |= used
    if kept is not None:
        code += _remembered(kept)
    fill = {"T": real, "F": suffix, "P": name}
    return HEADER.format(
        title=for_comment(learned.title),
        type=real,
        name=name,
        guard=name.upper(),
        observations=observations,
        controls=len(learned.task.control_names),
        observation=for_comment(", ".join(learned.observation)),
        control=for_comment(", ".join(learned.task.control_names)),
        period=float(learned.task.dt),
        forgets=": there is nothing to forget" if kept is None else "; one controller of this kind in a program",
        memory="" if kept is None else _memory(kept, name, real),
        reset="" if kept is None else f" {name}_began = 0; ",
        arrays="\n".join(_table(f"{name}_{key}", value) for key, value in arrays.items()),
        code=textwrap.indent(
            "\n".join(re.sub(r"@([TFP])", lambda found: fill[found[1]], line) for line in code), "    "
        ),
    ).encode()


def _printed(layer: Layer, i: int, size: int) -> tuple[list[str], dict[str, np.ndarray], int]:
    """The lines of a layer, the tables that they name, and its size; v{i-1} [size] goes in, v{i} comes out.

    @T is the type of numbers, @F the end of a function's or a number's name of that type, @P the prefix of names.
    """
    before = f"v{i - 1}"
    match layer:
        case Recall():
            return _recalled(layer, f"v{i}"), {"rest": layer.rest}, layer.size
        case Features(plain, angles):
            lines, count, given = [f"@T v{i}[{layer.size}];"], len(angles), before if i else "x"
            lines += [f"v{i}[{place}] = {given}[{entry}];" for place, entry in enumerate(plain)]
            for place, pair in enumerate(angles, start=len(plain)):
                angle = _entry(pair, given)
                lines += [f"v{i}[{place}] = sin@F({angle});", f"v{i}[{place + count}] = cos@F({angle});"]
            return lines, {}, layer.size
        case Standardize(mean, scale):
            loop = f"for (int i = 0; i < {size}; ++i) v{i}[i] = ({before}[i] - @P_mean{i}[i]) / @P_scale{i}[i];"
            return [f"@T v{i}[{size}];", loop], {f"mean{i}": mean, f"scale{i}": scale}, size
        case Dense(kernel, bias, relu):
            width = len(bias)
            # Along the outputs: a compiler can do several at once without another order of sums.
            lines = [
                f"@T v{i}[{width}];",
                f"for (int j = 0; j < {width}; ++j) v{i}[j] = @P_bias{i}[j];",
                f"for (int i = 0; i < {size}; ++i)",
                f"    for (int j = 0; j < {width}; ++j) v{i}[j] += {before}[i] * @P_kernel{i}[i * {width} + j];",
            ]
            if relu:
                lines.append(f"for (int j = 0; j < {width}; ++j) v{i}[j] = v{i}[j] > 0 ? v{i}[j] : 0;")
            return lines, {f"kernel{i}": kernel, f"bias{i}": bias}, width
        case Kernels(centers, lengthscales, weights):
            controls, count = weights.shape
            lines = [
                f"@T v{i}[{controls}];",
                f"for (int k = 0; k < {controls}; ++k) {{",
                "    double sum = 0;",
                f"    for (int n = 0; n < {count}; ++n) {{",
                "        double squares = 0;",
                f"        for (int i = 0; i < {size}; ++i) {{",
                f"            const double far = ({before}[i] - @P_centers{i}[n * {size} + i])"
                f" / @P_lengthscales{i}[k * {size} + i];",
                "            squares += far * far;",
                "        }",
                f"        sum += @P_weights{i}[k * {count} + n] * exp(-0.5 * squares);",
                "    }",
                f"    v{i}[k] = (@T)sum;",
                "}",
            ]
            return lines, {f"centers{i}": centers, f"lengthscales{i}": lengthscales, f"weights{i}": weights}, controls
        case Squash(kind, low, high):
            squash = {"tanh": f"tanh@F({before}[i])", "sine": "(3 * s - s * s * s) / 2"}[kind]
            lines = [
                f"for (int i = 0; i < {len(low)}; ++i) {{",
                *([f"    const @T s = sin@F({before}[i]);"] if kind == "sine" else []),
                f"    const @T v = @P_middle[i] + @P_half[i] * {squash};",
                "    u[i] = v < @P_low[i] ? @P_low[i] : v > @P_high[i] ? @P_high[i] : v;",
                "}",
            ]
            return lines, {"low": low, "high": high, "middle": layer.middle, "half": layer.half}, len(low)
        case Limit(change):
            lines = [
                f"for (int i = 0; i < {len(change)}; ++i) {{",
                "    const @T least = @P_past[i] - @P_change[i], most = @P_past[i] + @P_change[i];",
                "    u[i] = u[i] < least ? least : u[i] > most ? most : u[i];",
                "}",
            ]
            return lines, {"change": change}, len(change)


def _entry(entries: tuple[int, ...], given: str = "x") -> str:
    """An entry of the state, of one or two of the observation."""
    first, *second = (f"{given}[{entry}]" for entry in entries)
    return f"atan2@F({second[0]}, {first})" if second else first


def _memory(layer: Recall, name: str, real: str) -> str:
    """The declarations of what is remembered, at least one number each."""
    n = len(layer.state)
    sizes = {"past": layer.controls * len(layer.rest), "rows": layer.rows * n, "before": n, "rate": n}
    return f"static int {name}_began = 0;\n" + "".join(
        f"static {real} {name}_{key}[{max(size, 1)}];\n" for key, size in sizes.items()
    )


def _recalled(layer: Recall, v: str) -> list[str]:
    """The lines that make what the policy sees of x, and of what is remembered."""
    n, controls, rows = len(layer.state), layer.controls * len(layer.rest), layer.rows * len(layer.state)
    lines = [f"@T {v}[{layer.size}];", *(f"{v}[{i}] = {_entry(entry)};" for i, entry in enumerate(layer.state))]
    lines += [
        "if (!@P_began) {",
        f"    for (int i = 0; i < {controls}; ++i) @P_past[i] = @P_rest[i % {len(layer.rest)}];",
        f"    for (int i = 0; i < {rows}; ++i) @P_rows[i] = {v}[i % {n}];",
        f"    for (int i = 0; i < {n}; ++i) {{ @P_before[i] = {v}[i]; @P_rate[i] = 0; }}",
        "    @P_began = 1;",
        "}",
    ]
    if layer.rates:
        lines += [f"@T change[{n}];", f"for (int i = 0; i < {n}; ++i) change[i] = {v}[i] - @P_before[i];"]
        lines += [f"change[{i}] = atan2@F(sin@F(change[{i}]), cos@F(change[{i}]));" for i in layer.turning]
        weight, dt = f"(@T){layer.weight!r}", f"(@T){layer.dt!r}"
        lines.append(f"for (int i = 0; i < {n}; ++i) @P_rate[i] += {weight} * (change[i] / {dt} - @P_rate[i]);")
    for name, first, size in (("past", n, controls), ("rows", n + controls, rows), ("rate", n + controls + rows, n)):
        if size and (layer.rates or name != "rate"):
            lines.append(f"for (int i = 0; i < {size}; ++i) {v}[{first} + i] = @P_{name}[i];")
    first = layer.size - len(layer.asked)
    return lines + [f"{v}[{first + i}] = x[{entry}];" for i, entry in enumerate(layer.asked)]


def _remembered(layer: Recall) -> list[str]:
    """The lines after the control was computed: v0 begins with the state."""
    n, lines = len(layer.state), []
    for name, new, size, count in (
        ("past", "u", len(layer.rest), layer.controls * len(layer.rest)),
        ("rows", "v0", n, layer.rows * n),
    ):
        if count:
            lines.append(f"for (int i = {count} - 1; i >= {size}; --i) @P_{name}[i] = @P_{name}[i - {size}];")
            lines.append(f"for (int i = 0; i < {size}; ++i) @P_{name}[i] = {new}[i];")
    return [*lines, f"for (int i = 0; i < {n}; ++i) @P_before[i] = v0[i];"]


def _table(name: str, array: np.ndarray) -> str:
    """A table of numbers that read back to the last bit."""
    real, suffix = TYPES[array.dtype.name]
    numbers = ", ".join(str(value) + suffix for value in array.ravel())
    return f"static const {real} {name}[{array.size}] = {{\n{textwrap.fill(numbers, 112, break_on_hyphens=False)}\n}};"


def compiler() -> list[str]:
    """The command of a C compiler: $CC, or the first of cc, gcc and clang. Raises ConfigError without one."""
    found = split(os.environ.get("CC", "")) or [*filter(shutil.which, COMPILERS)][:1]
    if not found or not shutil.which(found[0]):
        raise ConfigError(
            "format=c needs a C compiler to compare the header with the policy, and there is no cc, gcc or clang here"
            " (CC=... names another); format=numpy needs none"
        )
    return found


def run(path: Path, observations: np.ndarray, episode: int) -> np.ndarray:
    """What the header at `path` does for observations [N, O], of so many an episode, compiled here: controls [N, U]."""
    name, text = path.stem, path.read_text(encoding="utf-8")
    controls = int(re.search(rf"define {name.upper()}_CONTROLS (\d+)", text)[1])  # type: ignore[index]
    check = CHECK.format(
        name=name,
        type=TYPES[observations.dtype.name][0],
        observations=observations.shape[1],
        controls=controls,
        episode=episode,
    )
    with tempfile.TemporaryDirectory() as folder:
        program = Path(folder) / "check"
        program.with_suffix(".c").write_text(check, encoding="utf-8")
        command = [*compiler(), "-std=c99", "-O2", "-I", str(path.parent), f"{program}.c", "-o", str(program), "-lm"]
        for words, given in ((command, None), ([str(program)], observations.tobytes())):
            done = subprocess.run(words, input=given, capture_output=True, check=False)
            if done.returncode:
                raise ConfigError(f"format=c: {words[0]} failed: {' '.join(done.stderr.decode().split())[:200]}")
    return np.frombuffer(done.stdout, observations.dtype).reshape(-1, controls)
