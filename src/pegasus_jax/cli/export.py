"""The command pegasus-export: a run's policy as a file that runs without this package."""

import json
import sys
from collections.abc import Sequence

from pegasus_jax.checks import true
from pegasus_jax.cli.main import main
from pegasus_jax.cli.runs import run_and, trial_of
from pegasus_jax.cli.words import OF_RUN

EXPORT = """\
pegasus-export RUN [trial=best] [format=numpy] [out=FILE] [overwrite=false]     write a policy to a file

Writes the policy as one file that needs neither this package nor, except for stablehlo, JAX. trial= chooses the policy:
best, last, or the number of a trial. Beside the file it writes FILE.json, the contract: names, units and order of
observations and controls, limits, period, versions. It compares the file's controls with the policy's on 1,000
observations, stored and random ones, and keeps no file that differs by more than 1e-5 of the control range.

  format=numpy          a Python module of plain NumPy with its weights inside (default: RUN/controller.py)
         c              a C99 header without allocation; a C compiler is needed to compare it (RUN/controller.h)
         onnx           a graph for onnxruntime and others; it takes a batch of observations (RUN/controller.onnx)
         stablehlo      a function for jax.export.deserialize; it can hold any policy (RUN/controller.stablehlo)

onnx needs the extra `export`: pip install 'pegasus-jax[export]'.

examples
  pegasus-export runs/cartpole-seed0
  pegasus-export runs/cartpole-seed0 format=c trial=12 out=firmware/balance.h
"""


def export() -> None:
    """Entry point of pegasus-export."""
    main(handle, EXPORT, stopped="nothing was written")


def handle(words: Sequence[str]) -> None:
    """Export a policy, and say how close the file is to it. Raises ConfigError for words that cannot be."""
    run, rest = run_and(words, OF_RUN["pegasus-export"])
    overwrite = true("overwrite", rest["overwrite"])
    trial = trial_of(rest["trial"])
    # At once: to import JAX and to compile the policy takes a while. Standard output is for what was written.
    told = f"exporting {run}, and comparing the file with its policy on 1,000 observations"
    print(told, file=sys.stderr, flush=True)
    from pegasus_jax.exports import write
    from pegasus_jax.runs.restore import chosen

    file = write.export(run, trial, rest["format"], rest["out"] or None, overwrite)
    contract = json.loads(write.contract_of(file).read_bytes())
    parity = contract["parity"]
    print(f"{file}: {contract['title']}")
    print(chosen(run, trial, contract["trial"]))
    print(f"{write.contract_of(file)}: its contract")
    seen, stored = (f"{parity[name]:,}" for name in ("observations", "stored"))
    print(f"{seen} observations, {stored} of them stored: it differs from the policy by at most", end=" ")
    print(f"{parity['largest_difference']:.1e} of the control range; {parity['allowed']:.1e} is allowed")


if __name__ == "__main__":
    export()
