"""The table and the picture of the runs."""

from collections.abc import Sequence
from pathlib import Path
from statistics import median
from typing import Any

import matplotlib

matplotlib.use("Agg")

import matplotlib.pyplot as plt

from benchmarks.peers.solve.attempt import PLANTS, PROGRAMS
from pegasus_jax.runs.files import write_whole

Run = dict[str, Any]
NAMES = {
    "cartpole": "cart-pole",
    "pendulum": "Pendulum-v1",
    "mc_pilco": "MC-PILCO",
    "sac": "SAC (SBX)",
    "crossq": "CrossQ (SBX)",
}
CLOCKS = {"plant_seconds": "plant time [s]", "cpu_seconds": "CPU time [s]", "wall_seconds": "wall time [s]"}
OURS = "pegasus_jax"


def used(run: Run, clock: str) -> float:
    """What a run had used when its last policy was judged: the one that solved, or the last before the limit."""
    last = run["policies"][-1][clock] if run["policies"] else 0.0
    return last if run["solved"] or clock != "cpu_seconds" else max(last, run["limit"])


def middle(runs: Sequence[Run], clock: str) -> tuple[bool, float]:
    """(whether it is a lower bound, the median) of the seeds, those that were not solved being the longest."""
    ordered = sorted((not run["solved"], used(run, clock)) for run in runs)
    return ordered[len(ordered) // 2] if len(ordered) % 2 else (ordered[-1][0], median(v for _, v in ordered))


def short(value: float) -> str:
    """Three digits at most, and no exponent."""
    return f"{value:.0f}" if value >= 100 else f"{value:.2g}" if value < 10 else f"{value:.3g}"


def cells(runs: Sequence[Run], ours: Sequence[Run]) -> list[str]:
    """The seeds on each clock, sorted, `>` where one was not solved; then how often our median goes into theirs."""
    shown = [
        ", ".join((">" if late else "") + short(v) for late, v in sorted((not r["solved"], used(r, c)) for r in runs))
        for c in CLOCKS
    ]
    for clock in ("plant_seconds", "cpu_seconds"):
        (late, theirs), (unsolved, own) = middle(runs, clock), middle(ours, clock) if ours else (True, 1.0)
        shown.append("" if unsolved or runs == ours else (">" if late else "") + short(theirs / own))
    return shown


def table(runs: Sequence[Run]) -> str:
    """A row in Markdown for each program on each plant that it ran on without an error."""
    head = ["plant", "program", "solved", *CLOCKS.values(), "plant time / ours", "CPU time / ours"]
    lines = [head, ["---"] * len(head)]
    for plant in PLANTS:
        of_plant = [run for run in runs if run["plant"] == plant and not run["error"]]
        ours = [run for run in of_plant if run["program"] == OURS]
        for program in PROGRAMS:
            if own := [run for run in of_plant if run["program"] == program]:
                limits = "" if all(run["solved"] for run in own) else f" within {max(r['limit'] for r in own):g} s"
                solved = f"{sum(run['solved'] for run in own)} of {len(own)}{limits}"
                lines.append([NAMES[plant], NAMES.get(program, program), solved, *cells(own, ours)])
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def picture(runs: Sequence[Run], path: Path) -> None:
    """Wall time against plant time, a mark for each run: full where it was solved, hollow where the limit ended it."""
    plants = [plant for plant in PLANTS if any(run["plant"] == plant for run in runs)]
    figure, axes = plt.subplots(1, len(plants), figsize=(4.2 * len(plants), 3.4), sharey=True, squeeze=False)
    for axis, plant in zip(axes[0], plants, strict=True):
        for color, (program, mark) in enumerate(zip(PROGRAMS, "osD^v", strict=True)):
            for run in runs:
                if (run["plant"], run["program"]) == (plant, program) and run["policies"]:
                    at = [[used(run, clock)] for clock in ("plant_seconds", "wall_seconds")]
                    face = f"C{color}" if run["solved"] else "none"
                    axis.plot(*at, mark, color=f"C{color}", markerfacecolor=face, markersize=7, linestyle="none")
            axis.plot([], [], mark, color=f"C{color}", label=NAMES.get(program, program))
        axis.set(xscale="log", yscale="log", xlabel=CLOCKS["plant_seconds"], title=NAMES[plant])
        axis.grid(alpha=0.3)
        for one in (axis.xaxis, axis.yaxis):
            one.set_major_formatter("{x:g}")
            one.set_minor_formatter("")
    axes[0][0].set_ylabel(CLOCKS["wall_seconds"])
    figure.legend(*axes[0][0].get_legend_handles_labels(), loc="lower center", ncols=len(PROGRAMS), frameon=False)
    figure.tight_layout(rect=(0, 0.08, 1, 1))
    write_whole(path, lambda file: figure.savefig(file, format="png", dpi=80))
    plt.close(figure)
