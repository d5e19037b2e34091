"""One experiment of the paper, or of yours: run what is missing, draw it, test its claims. `--help` says the words.

make figures FIGURE=crn
"""

import shlex
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from pegasus_jax.checks import ConfigError
from pegasus_jax.cli.main import main

HELP = """\
python -m benchmarks.paper FILE [out=runs/figures] [seeds=0-9] [variants=A,B] [setting=value ...]

Compares learning curves. FILE is TOML and says what varies, over which seeds and how many trials. Each variant is one
vmapped program of all its seeds and leaves OUT/NAME-VARIANT.json, written after every trial; one that is there already
is not run again. Then draws OUT/NAME.png (every seed thin, the interquartile mean thick with its 95 % bootstrap
interval) and prints what came out, and what that says to the file's claims.

  out=runs/figures      the folder of the studies; NAME is FILE without .toml
  seeds=0-9             instead of the file's; or seeds=0,3,7
  variants=A,B          run only these; all that are there are drawn
  setting=value         in every variant, instead of the file's; pegasus-train --help=all lists settings

a file
  title = "How wide a policy?"
  trials = 15
  common = "task=cartpole algorithm=pegasus"
  [variants]
  narrow = "policy.hidden=[50,50]"
  wide = "policy.hidden=[200,200]"

With picture = "area", the area under each learning curve, a dot a seed. The paper's own are in benchmarks/paper/.
On two CPU cores a variant of ten seeds takes most of an hour, on one GPU a minute or two.
"""


def compare(words: Sequence[str]) -> None:
    """The command, given its words."""
    from benchmarks.paper import claims, comparison  # here: a refused command does not wait for JAX
    from benchmarks.paper.figures import read
    from pegasus_jax.runs import config_io
    from pegasus_jax.runs.programs import share_cpus
    from pegasus_jax.runs.study import seed_list

    files = [word for word in words if "=" not in word]
    if len(files) != 1:
        raise ConfigError(f"name one file, not {len(files)}; for example benchmarks/paper/crn.toml")
    options, changed = config_io.split([word for word in words if "=" in word], comparison.OPTIONS)
    asked: dict[str, Any] = dict(seeds=options.get("seeds", ""), changes=[f"{k}={v}" for k, v in changed.items()])
    only = [label for label in options.get("variants", "").split(",") if label]
    figure, out = read(Path(files[0])), Path(options.get("out", "runs/figures"))
    share_cpus(len(seed_list(asked["seeds"] or figure.seeds)))
    command = shlex.join(["python", "-m", "benchmarks.paper", *words])
    there = comparison.run(figure, out, only=only, command=command, **asked)
    for line in comparison.differences(figure, there, **asked):
        print(line, file=sys.stderr)
    print(claims.markdown(claims.variants_table(figure, out)))
    if figure.claims:
        print(f"\n{claims.markdown(claims.claims_table(figure, out))}")
    print(comparison.draw(figure, there, out))


if __name__ == "__main__":
    main(compare, HELP, stopped="finished variants are kept, the same command goes on")
