"""The command pegasus-run: a run's environment, maybe a robot, driven by its exported policy."""

from collections.abc import Sequence

from pegasus_jax.checks import ConfigError, check_range, whole
from pegasus_jax.cli.main import main
from pegasus_jax.cli.runs import run_and, trial_of
from pegasus_jax.cli.words import OF_RUN

RUN = """\
pegasus-run RUN [trial=best] [episodes=1] [seconds=...] [watchdog=...]     drive a run's environment with its policy

Drives the environment of a task=gym, which may be a robot, at its control period. It exports the policy to NumPy first,
and compares the file with the policy. trial= chooses the policy: best, last, or the number of a trial. Nothing is
learned.

  episodes=1            number of episodes, each with a reset of the environment; the first gets seed=0
  seconds=...           length of an episode (default: that of the run's own episodes)
  watchdog=...          close the environment if no control is sent for so many seconds, because `step` hangs or the
                        computer is too slow (default: five periods, and at least 0.5 s)

Each episode leaves RUN/driven/NNNN.npz. It has the arrays of the run's own episodes; `time` [s], when each control was
sent; and `overruns`, the number of controls that were more than a tenth of a period late. Ctrl-C closes the
environment, which stops the motors, and keeps the rows so far. If `step` does not wait, the command keeps the period.

examples
  pegasus-run runs/gym-robot-Arm-v0-seed0
  pegasus-run runs/gym-robot-Arm-v0-seed0 trial=12 seconds=60 watchdog=0.2
"""


def run() -> None:
    """Entry point of pegasus-run."""
    main(handle, RUN, stopped="its rows are kept")


def handle(words: Sequence[str]) -> None:
    """Drive, and say how each episode went. Raises ConfigError for words that cannot be."""
    folder, rest = run_and(words, OF_RUN["pegasus-run"])
    episodes, seed = (whole(name, rest[name]) for name in ("episodes", "seed"))
    seconds, watchdog = (_seconds(name, rest[name]) for name in ("seconds", "watchdog"))
    trial = trial_of(rest["trial"])
    from pegasus_jax.exports.drive import drives

    given = dict(episodes=episodes, seed=seed, seconds=seconds, watchdog=watchdog)
    for done in drives(folder, trial, **given):  # type: ignore[arg-type]
        print(
            f"{done.log}: {len(done.times)} controls, mean cost {done.cost:.3f}, ended by {done.episode.ended};",
            end=" ",
        )
        longest = f"longest period {done.longest:.4g} s, planned {done.period:g} s"
        print(f"overruns: {done.overruns}; {longest}", flush=True)


def _seconds(name: str, text: str) -> float | None:
    """So many seconds, None where nothing is said. Raises ConfigError for what is no number above 0."""
    if not text:
        return None
    try:
        value = float(text)
    except ValueError as error:
        raise ConfigError(f"{name}={text} is not a number of seconds; for example {name}=2.5") from error
    check_range(name, value, 0, 86400, open_low=True)
    return value


if __name__ == "__main__":
    run()
