"""The generated tables: what each preset learns (README.md's, and docs/results.md's by trial), and peers' speed.

A row is a preset and the stored studies that measured it. The settings in which these studies differ from the preset
are computed from the stored configs, so that a row cannot claim a preset that nobody measured.
"""

import json
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from benchmarks import own_cost, study
from benchmarks.paper import claims
from benchmarks.paper.comparison import Result, measured, numbered
from benchmarks.paper.comparison import stored as read
from pegasus_jax.config import MANEUVERS
from pegasus_jax.presets import PRESETS, own
from pegasus_jax.runs import config_io
from pegasus_jax.runs.study import SOLVED

README_HEADER = ["task", "preset", "changed settings", "trial", "trials", "seeds"]
README_HEADER += ["first trial at 90 %", "at 90 % in the last", "cost in the last"]
TRIALS = (2, 3, 4, 5, 6, 7, 8, 10, 12, 15, 16, 20, 24, 40)
FREE = ("seed", "trials", "eval_episodes")  # a preset's results hold for any of these


class Row(NamedTuple):
    """A preset with the studies that measured it: stems of files in benchmarks/results with the same config."""

    task: str  # what a reader calls it
    preset: str
    studies: tuple[str, ...]
    module: Any = study  # the program that runs such a study


ROWS = (
    Row("cart-pole", "cartpole", ("cartpole-50",)),
    Row(
        "cart-pole as your own plant: any cost, network",
        "cartpole_network",
        ("cartpole-own_cost-50",),
        own_cost,
    ),
    Row("double cart-pole, eight policies, on a GPU", "double_cartpole_gpu", ("double_cartpole-reheated",)),
    Row("double cart-pole, one policy", "double_cartpole", ("double_cartpole-default",)),
    *(
        Row(f"swimmer, {name.replace('_', ' ')}{words}", own(f"swimmer_{name}", legs), (f"{files}-{name}",))
        for legs, words, files in ((2, "", "swimmer"), (6, ", six legs", "six_legs"))
        for name in MANEUVERS
    ),
)
MORE = (
    Row("cart-pole, the paper's network", "cartpole_network", ("cartpole_network-50",)),
    Row("cart-pole as your own plant: any cost, a mechanism", "cartpole", ("cartpole-own_cost-mechanism",), own_cost),
    Row("cart-pole, four policies, on a GPU", "cartpole", ("cartpole-four_policies",)),
)


class Peer(NamedTuple):
    """Another program's part, and where our time over its time is: the file of `benchmarks.peers.compare`, the key."""

    name: str
    file: str
    key: str


PEERS = (
    Peer("the same search step in PyTorch, `torch.compile`", "peers", "ours_of_compiled"),
    Peer("the authors' PyTorch program, prob_mbrl: a search step", "peers-prob_mbrl", "ours_of_prob_mbrl"),
    Peer("prob_mbrl: a fit step, with other noise on the units", "peers-prob_mbrl", "ours_of_prob_mbrl_fit"),
    Peer("MC-PILCO's search step, ours in float32", "peers-mc_pilco", "ours_of_mc_pilco"),
    Peer("MC-PILCO's search step, both in float64", "peers-mc_pilco", "ours_double_of_mc_pilco"),
)


def pooled(row: Row, out: Path) -> Result:
    """The studies of a row as one, over all their seeds. Raises ValueError where their configs differ."""
    parts = [found for stem in row.studies if (found := read(out, stem)) is not None]
    if len(parts) < len(row.studies) or len({changes(row, one) for one in parts}) > 1:
        raise ValueError(f"the studies {', '.join(row.studies)} are not of one config, or one is missing")
    together = ("seeds", "mean_cost", "success_rate")
    return parts[0] | {name: [value for part in parts for value in part[name]] for name in together}


def changes(row: Row, result: Result) -> str:
    """The words that make the stored config of the row's preset; "" where it is the preset."""
    own, made = config_io.leaves(numbered(PRESETS[row.preset])), config_io.leaves(measured(result))
    return " ".join(f"{key}={word(made[key])}" for key in made if key not in FREE and made[key] != own.get(key))


def word(value: Any) -> str:
    """A setting's value as a word of the command line."""
    if isinstance(value, tuple):
        return f"[{','.join(map(word, value))}]"
    if value is None or isinstance(value, bool):
        return {True: "true", False: "false", None: "null"}[value]
    return f"{value:g}" if isinstance(value, float) else str(value)


def spans(seeds: list[int]) -> str:
    """Seeds as ranges: 0-9, 15, 20-29."""
    cuts = [i for i, (a, b) in enumerate(pairwise(seeds), 1) if b != a + 1]
    ends = [(seeds[a], seeds[b - 1]) for a, b in pairwise([0, *cuts, len(seeds)])]
    return ", ".join(f"{first}-{last}" if last > first else f"{first}" for first, last in ends)


def readme_table(out: Path) -> str:
    """README.md's table of results, from the studies in `out`."""
    return claims.markdown([README_HEADER, *(readme_row(row, pooled(row, out)) for row in ROWS)])


def peers_table(out: Path) -> str:
    """README.md's comparison: our seconds over another program's, for the sizes that every peer was timed at."""
    files = {peer.file: json.loads((out / f"{peer.file}.json").read_text())["rows"] for peer in PEERS}
    sizes = [size for size in files["peers"] if all(size in rows for rows in files.values())]
    lines = [[peer.name, *(f"{files[peer.file][size][peer.key]:.2f}" for size in sizes)] for peer in PEERS]
    return claims.markdown([["our time over theirs", *sizes], *lines])


def readme_row(row: Row, result: Result) -> list[str]:
    """One preset: how its seeds learned."""
    _, _, trials, last, _, solved, first = claims.row("", result)
    changed = changes(row, result)
    seconds = f"{result['plant_seconds'][0]:g} s"
    labels = [row.task, f"`{row.preset}`", f"`{changed}`" if changed else "none", seconds, trials]
    return [*labels, spans(result["seeds"]), first, solved, last]


def by_trial(out: Path) -> str:
    """How many seeds of each row have been at 90 % by a trial."""
    lines = [["task", "seeds", *map(str, TRIALS)]]
    for row in (*ROWS, *MORE):
        result = pooled(row, out)
        solved = np.maximum.accumulate(np.asarray(result["success_rate"]) >= SOLVED, axis=1).sum(0)
        counts = [str(solved[t - 1]) if t <= len(solved) else "" for t in TRIALS]
        lines.append([row.task, str(len(result["seeds"])), *counts])
    return claims.markdown(lines) + "\n"
