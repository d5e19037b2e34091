"""One learning study of this project's records (runs/study.py; `benchmarks.paper` compares several).

    python -m benchmarks.study NAME seeds=0-9 task=cartpole trials=15 [setting=value ...]

Writes benchmarks/results/NAME.json: per seed and trial the mean cost of 20 evaluation episodes and their success rate.
A study that is finished is not written over.
"""

import shlex

from benchmarks import RESULTS, command, named, unfinished
from pegasus_jax.runs import config_io
from pegasus_jax.runs.machine import about
from pegasus_jax.runs.programs import share_cpus
from pegasus_jax.runs.study import seed_list, study, table, write


def main(words: list[str], module: str = "benchmarks.study") -> None:
    """The command line of this module, or of another that changes what it runs."""
    name, rest = named(words, "the name of the file that this writes, without .json")
    options, dotted = config_io.split(rest, ("seeds",))
    config = config_io.parse(dotted)
    path = unfinished(RESULTS / f"{name}.json")
    seeds = seed_list(options.get("seeds", "0-9"))
    share_cpus(len(seeds))
    result = study(config, seeds, path)
    result["about"] = about(shlex.join(["python", "-m", module, *words]))
    write(path, result)
    print(f"## {name}: compiled in {result['compile_seconds']} s, ran {result['run_seconds']} s")
    print(table(result), flush=True)


if __name__ == "__main__":
    command(main, __doc__)
