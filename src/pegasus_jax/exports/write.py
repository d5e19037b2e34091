"""A run's policy as a file: written, compared with the policy, and kept only if it is the same."""

import re
import shlex
import sys
import tempfile
from collections.abc import Callable
from functools import partial
from keyword import iskeyword
from pathlib import Path
from typing import NamedTuple

import numpy as np

from pegasus_jax.checks import ConfigError, brief, choice
from pegasus_jax.exports import as_c, as_numpy, as_onnx, as_stablehlo
from pegasus_jax.exports.contract import contract
from pegasus_jax.exports.learned import Learned
from pegasus_jax.exports.parity import compared
from pegasus_jax.runs import restore
from pegasus_jax.runs.files import write_json, write_whole


class Format(NamedTuple):
    """A kind of file."""

    suffix: str
    write: Callable[[Learned, str], bytes]  # (policy, a name for what is inside) -> the file
    # (file, observations [N, O], how many of them an episode has) -> controls [N, U]
    run: Callable[[Path, np.ndarray, int], np.ndarray]


FORMATS = {
    "numpy": Format(".py", as_numpy.write, as_numpy.run),
    "c": Format(".h", as_c.write, as_c.run),
    "onnx": Format(".onnx", as_onnx.write, as_onnx.run),
    "stablehlo": Format(".stablehlo", as_stablehlo.write, as_stablehlo.run),
}


@brief
def export(
    run: str | Path,
    trial: restore.Trial = restore.BEST,
    format: str = "numpy",
    out: str | Path | None = None,
    overwrite: bool = False,
) -> Path:
    """Write the policy of a run after a trial as a file that runs without this package; its path is returned.

    `trial` is as in `controller`. `format` is numpy (one module), c (one C99 header), onnx or stablehlo; `out` is the
    file, RUN/controller.py and so on where it is None. Beside it comes OUT.json, its contract: names, units and order
    of observations and controls, limits, period, versions, and the largest difference from the policy on 1,000
    observations. Raises RunError where that is more than 1e-5 of the control range beside the rounding of the policy
    itself, or the run has no such trial, and ConfigError for a format or a file that cannot be; then nothing is left.
    """
    choice("format", format, FORMATS)
    made, run = FORMATS[format], Path(run)
    file = destination(run, format, out, overwrite)
    config, experiment, state = restore.restored(run, trial)
    name, number = run.resolve().name, int(state.trial)
    learned = Learned(name, number, config, experiment.task, experiment.policy, state.policy.params)
    data = made.write(learned, file.stem)
    with tempfile.TemporaryDirectory() as folder:
        (unproven := Path(folder) / file.name).write_bytes(data)
        parity = compared(partial(made.run, unproven), learned, run)
    words = ["pegasus-export", str(run), f"trial={number}", f"format={format}", f"out={file}"]
    said = contract(learned, format, file, data, parity, shlex.join(words))
    write_whole(file, lambda opened: opened.write(data))
    write_json(contract_of(file), said)
    return file


def contract_of(file: Path) -> Path:
    """Where the contract of a file lies."""
    return file.with_name(f"{file.name}.json")


def destination(run: Path, format: str, out: str | Path | None, overwrite: bool) -> Path:
    """The file to write. Raises ConfigError for a name that cannot be, or a file that is there."""
    suffix = FORMATS[format].suffix
    file = run / f"controller{suffix}" if out is None else Path(out)
    # The name is that of a module, and of C functions; that of another module or header would hide it.
    name = re.sub(r"^(?=\d)|\W", "_", file.stem, flags=re.ASCII) or "controller"
    taken = iskeyword(name) or name in ("numpy", *sys.stdlib_module_names)
    right = Path(f"{name}_" if taken else name).with_suffix(suffix)
    if file.name != right.name:
        raise ConfigError(f"out={out} is no name for format={format}; the nearest is out={file.with_name(right.name)}")
    for path in (file, contract_of(file)):
        if path.is_dir():
            raise ConfigError(f"{path} is a folder; another out= is free")
        if path.exists() and not overwrite:
            raise ConfigError(f"{path} is there already; overwrite=true replaces it, another out= keeps it")
    return file
