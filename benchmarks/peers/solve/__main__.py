"""Plant seconds and wall seconds until a plant is solved, of other programs beside ours, in turn on one core.

    python -m benchmarks.peers.solve [plants=cartpole,pendulum] [programs=pegasus_jax,sac,...] [seeds=0-2] [core=1]
        [limit=600] [python=PATH] [mc_pilco=CHECKOUT] [prob_mbrl=CHECKOUT] [out=benchmarks/results/peers-solve.json]
    python -m benchmarks.peers.solve show

A plant is solved by the first policy that reaches the plant's bar, which attempt.py has for all programs alike: on the
cart-pole 90 % of 20 episodes succeed, on Pendulum-v1 the mean return of 10 episodes is -200. What judges is on no
clock. Everything else is, starting and compiling too. `limit` is one of CPU seconds: others may use the machine.

`python` is one that has this package and the programs', by default this one: `pip install sbx-rl` for SAC and CrossQ,
`pip install torch tqdm joblib` for MC-PILCO and prob_mbrl, which are checkouts of github.com/merlresearch/MC-PILCO and
github.com/mcgillmrl/prob_mbrl. `of_*.py` say what each program's settings are, and what was adapted.

Runs that the file has are not done again, but those that failed; it is written after each run, and the table is
printed. `show` writes the table of the stored runs into docs/comparison.md, and draws their picture, peers-solve.png.
"""

import json
import os
import shlex
import sys
import tempfile
from pathlib import Path
from typing import Any

from benchmarks import RESULTS, command, number, only, stored_runs
from benchmarks.peers.solve.attempt import PLANTS, PROGRAMS
from benchmarks.peers.solve.shown import picture, table
from benchmarks.plants_suite.__main__ import on_core
from benchmarks.results_page import write
from pegasus_jax.checks import ConfigError, did_you_mean
from pegasus_jax.runs.files import write_json
from pegasus_jax.runs.machine import about
from pegasus_jax.runs.study import seed_list

OPTIONS = ("plants", "programs", "seeds", "core", "limit", "python", "mc_pilco", "prob_mbrl", "out")
NUMBERS = {"core": 1, "limit": 600}
CHECKOUTS = {"mc_pilco": "policy_learning/MC_PILCO.py", "prob_mbrl": "prob_mbrl/algorithms/mc_pilco.py"}
PAGE = Path(__file__).parents[3] / "docs" / "comparison.md"
BEGIN = "<!-- generated: python -m benchmarks.peers.solve show -->\n"


def chosen(name: str, text: str | None, known: dict[str, Any]) -> list[str]:
    """The plants or the programs that an option names, all without it. ConfigError for one that is not known."""
    names = [*known] if text is None else text.strip("[]").split(",")
    for one in names:
        if one not in known:
            raise ConfigError(f"{name}={one} is unknown; {did_you_mean(one, known)}")
    return names


def asked(words: list[str]) -> tuple[dict[str, str], list[tuple[str, int, str]]]:
    """(options, the runs as plant, seed, program). Raises ConfigError for what cannot be run."""
    options = only(words, OPTIONS)
    ready = {name: name in options for name in CHECKOUTS}
    programs = chosen("programs", options.get("programs"), PROGRAMS)
    if "programs" not in options:
        programs = [name for name in programs if ready.get(name, True)]
    for name, file in CHECKOUTS.items():
        if name in programs and not (Path(options.get(name, "")) / file).is_file():
            raise ConfigError(f"{name}={options.get(name, '')} is not a checkout of it: there is no {file}")
    for name, default in NUMBERS.items():
        number(options, name, default, 0)
    seeds = seed_list(options.get("seeds", "0-2").strip("[]"))
    plants = chosen("plants", options.get("plants"), PLANTS)
    runs = [(plant, seed, program) for plant in plants for seed in seeds for program in programs]
    return options, [run for run in runs if run[0] in PROGRAMS[run[2]][1]]


def one(plant: str, seed: int, program: str, options: dict[str, str]) -> dict[str, Any]:
    """One run: its policies as they were judged, and the load of the machine when it began."""
    core, limit = (number(options, name, default, 0) for name, default in NUMBERS.items())
    python = sys.executable if program == "pegasus_jax" else options.get("python", sys.executable)
    load = os.getloadavg()[0]
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "rows"
        words = [program, plant, str(seed), str(limit), str(file), str(Path(options.get(program, ".")).absolute())]
        _, error = on_core([python, "-m", "benchmarks.peers.solve.attempt", *words], core, None)
        rows = [json.loads(line) for line in file.read_text().splitlines()] if file.exists() else []
    solved = bool(rows) and rows[-1]["value"] >= PLANTS[plant].bar
    run = {"plant": plant, "seed": seed, "program": program, "limit": limit, "core": core, "load": load}
    return run | {"solved": solved, "error": error, "policies": rows}


def done(out: Path) -> list[dict[str, Any]]:
    """The runs of a file, if it is there, but those that failed. ConfigError for a file of something else."""
    return [run for run in stored_runs(out) if not run["error"]]


def main(words: list[str]) -> None:
    """The command line of this module."""
    out = RESULTS / "peers-solve.json"
    if words != ["show"]:
        options, runs = asked(words)
        out = Path(options.get("out", out))
        for plant, seed, program in runs:
            if any((run["plant"], run["seed"], run["program"]) == (plant, seed, program) for run in done(out)):
                continue
            new = one(plant, seed, program, options)
            said = new["error"] or json.dumps(new["policies"][-1] if new["policies"] else None)
            print(f"{plant} {program} seed {seed}: {'' if new['solved'] else 'not '}solved, {said}", flush=True)
            told = about(shlex.join(["python", "-m", "benchmarks.peers.solve", *words]))
            write_json(out, {"runs": [*done(out), new], "about": told})  # another command may have added to it
    print(table(done(out)))
    if words == ["show"]:
        picture(done(out), out.with_suffix(".png"))
        write(PAGE, f"\n{table(done(out))}\n\n", BEGIN)


if __name__ == "__main__":
    command(main, __doc__)
