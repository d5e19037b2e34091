"""The command pegasus-report: runs as one page that needs nothing else."""

import os
import sys
from collections.abc import Sequence
from pathlib import Path

from pegasus_jax.checks import ConfigError, true
from pegasus_jax.cli.main import main
from pegasus_jax.cli.runs import paths_and
from pegasus_jax.cli.words import OF_RUN

REPORT = """\
pegasus-report RUN [out=RUN/report.html] [film=false] [csv=FOLDER]     a run as one HTML file
pegasus-report FOLDER|RUN ... [out=FOLDER/report.html]                 several runs side by side

The report of a run, finished or not, has warnings and what they mean, learning curves, calibration, each trial's real
trajectory over the imagined ones, controls, the film of pegasus-play, the best policy, settings and versions. The file
needs no network.

The report of a folder, such as a sweep's, compares all runs in it. Runs that differ only in the seed are a group, with
every seed's raw curve, the interquartile mean and its 95 % bootstrap interval. Nothing is trained.

  out=FILE      the page (default for several runs that are named one by one: report.html)
  film=true     film the best policy first, as pegasus-play RUN does; for one run only
  csv=FOLDER    write every curve there as CSV too; the page links to them

examples
  pegasus-report runs/cartpole-seed0
  pegasus-report runs/sweep out=sweep.html csv=curves
"""


def report() -> None:
    """Entry point of pegasus-report."""
    main(handle, REPORT, stopped="nothing was written")


def handle(words: Sequence[str]) -> None:
    """Write the report of the runs named. Raises ConfigError for words that cannot be."""
    paths, options = paths_and(words, OF_RUN["pegasus-report"])
    filmed = true("film", options["film"])
    from pegasus_jax.runs import groups

    runs = groups.found(paths)
    if filmed:
        if len(runs) > 1:
            raise ConfigError(f"film=true is for one run, not {len(runs)}; for example {runs[0]}")
        from pegasus_jax.viz.video import film

        film(runs[0], 1, 0, "best")
    on_cpu()
    from pegasus_jax.report import build

    out = Path(options["out"] or (paths[0] / "report.html" if len(paths) == 1 else "report.html"))
    made = build.report(paths)
    for problem in made.problems:
        print(f"note: left out: {problem}", file=sys.stderr)
    for path in build.write(made, out, Path(options["csv"]) if options["csv"] else None):
        print(path)


def on_cpu() -> None:
    """Leave a GPU to the runs that are learning: who only reads asks for none. Not once JAX is there."""
    if "jax" not in sys.modules:
        os.environ["JAX_PLATFORMS"] = "cpu"


if __name__ == "__main__":
    report()
