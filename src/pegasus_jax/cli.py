"""The commands pegasus-train, -check, -eval, -plot, -play, -figures: they read `key=value` words end with 0 to 2."""

import json
import os
import shlex
import sys
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from pegasus_jax import cache, files, interrupt
from pegasus_jax.checks import SIZES, SettingError, within
from pegasus_jax.config import Search

TRAIN = """\
pegasus-train task=NAME [setting=value ...]     learn a controller
pegasus-train resume=RUN [trials=N ...]         go on with a run, also one that was killed; or with other evaluation=,
                                                fit.* or search.* settings

  task=cartpole         what to learn: {tasks}
  model=log_normal      dynamics model: {models}
                        (default: the one that learns the task best, of cartpole and double_cartpole lagrangian)
  policy=mlp            controller: {policies}
  algorithm=pegasus     how to search: {algorithms}
  out=runs/...          the run's folder (default: runs/TASK-seedN)
  final=true            run the last policy for one more episode, which is data if the run goes on
  seeds=1               so many seeds, from seed= on, as one program; each leaves its own run in OUT/seedN
  mesh=SEEDSxPARTICLES  the devices that share seeds and particles (default: as many GPUs, or cores of a CPU, as share
                        the seeds evenly)
  distributed=true      started on several hosts at once by SLURM or MPI: their devices act as one machine; without
                        those, coordinator=HOST:PORT processes=N process=I on each. They share OUT on one file system

A task and a named variant bring their own values of the settings below, which change them one by one. Shown is what
they are with the words beside --help: pegasus-train task=gym algorithm=paper --help
{settings}
{others}
PEGASUS_SETTINGS="fit.steps=5 search.steps=5" in the environment adds these words to every pegasus-train and
pegasus-figures command, after those that are typed: of two values of a setting, the last one counts.

examples
  pegasus-train task=cartpole
  pegasus-train task=cartpole policy.hidden=[50,50] seed=3 trials=10 out=runs/demo
  pegasus-train task=cartpole seeds=10
  pegasus-train task=cartpole algorithm=deep_pilco search.clip=1
  pegasus-train task=swimmer_corkscrew legs=6
  pegasus-train task=gym env=Pendulum-v1 cost=mymodule:cost horizon=40
  pegasus-train task=gym env=robot:Arm-v0 cost=robot:cost start_mean=[3.14,0] evaluation=0       (a robot)
  pegasus-train task=mjcf mjcf=arm.xml cost=mymodule:cost dt=0.05 horizon=40
  pegasus-train resume=runs/demo trials=20 search.steps=2000

Look at a run, finished or not, with pegasus-plot RUN, pegasus-eval RUN or pegasus-play RUN; or with
tensorboard --logdir RUN/tensorboard, after pip install tensorboard.
"""

CHECK = """\
pegasus-check task=NAME [setting=value ...]     look at a task before it is learned

Takes the words of pegasus-train, which looks first itself. Opens the environment, resets it once, drives nothing and
closes it; without start_mean= it is reset more often, as pegasus-train does. Prints spaces, limits, control period,
start and the cost there, and what its owner should know: a cost above 1, angles that look like degrees, readings that
never change or follow from others. What cannot be learned is one line, and the exit status 2.

examples
  pegasus-check task=gym env=robot:Arm-v0 cost=robot:cost angles=[0] start_mean=[3.14,0]
  pegasus-check task=mjcf mjcf=arm.xml cost=mymodule:cost dt=0.05 horizon=40
"""

EVALUATE = """\
pegasus-eval RUN [trial=last] [episodes=20] [seed=0] [json=true]     run a learned policy on its plant

Uses the policy after trial=N, trial=best or the last trial, and episodes that never become data. mjcf=FILE names the
model's file where it was moved.
Prints mean cost per step, success rate (last five steps cost less than .2 on average) and the run's fingerprint:
SHA-256 over data, model and policy parameters. With json=true, one JSON object.
"""

PLOT = """\
pegasus-plot RUN     draw a run, or the runs of many seeds, finished or not

Writes RUN/plots/learning.png (cost and success against plant time) and RUN/plots/trial_NNNN.png for every trial:
states, force and cost of the imagined particles after that trial, and over them what the plant did next.
For a folder of seeds, FOLDER/learning.png: every seed's raw curve thin, their interquartile mean thick with its 95 %
bootstrap interval.
"""

PLAY = """\
pegasus-play RUN [trial=last] [episodes=1] [seed=0]     film a learned policy on its plant

Writes RUN/play.mp4: fresh episodes of the newest whole checkpoint of the run, finished or not, in real time,
20 pictures a second, with cost and command drawn below as they come about. Another seed= gives other starts and
other noise. No display is needed: OpenGL comes from EGL or OSMesa, and MUJOCO_GL=egl|osmesa|glfw chooses; without
a graphics card a picture takes a tenth of a second or two, so a minute for the swimmer's 20 s.

examples
  pegasus-play runs/cartpole-seed0
  pegasus-play runs/cartpole-seed0 episodes=5 seed=1
"""

FIGURES = """\
pegasus-figures FILE [out=runs/figures] [seeds=0-9] [variants=A,B] [setting=value ...]     compare learning curves

FILE is TOML and says what varies, over which seeds and how many trials. Each variant is one vmapped program of all its
seeds and leaves OUT/NAME-VARIANT.json, written after every trial; one that is there already is not run again. Then
draws OUT/NAME.png (every seed thin, the interquartile mean thick with its 95 % bootstrap interval) and prints what came
out, and what that says to the file's claims.

  out=runs/figures      the folder of the studies; NAME is FILE without .toml
  seeds=0-9             instead of the file's; or seeds=0,3,7
  variants=A,B          run only these; all that are there are drawn
  setting=value         in every variant, instead of the file's; pegasus-train --help lists settings

a file
  title = "How wide a policy?"
  trials = 15
  common = "task=cartpole algorithm=pegasus"
  [variants]
  narrow = "policy.hidden=[50,50]"
  wide = "policy.hidden=[200,200]"

With picture = "area", the area under each learning curve, a dot a seed. The paper's own are in benchmarks/figures/.
On two CPU cores a variant of ten seeds takes most of an hour, on one GPU a minute or two.
"""


def train() -> None:
    """Entry point of pegasus-train."""
    main(_train, TRAIN)


def check() -> None:
    """Entry point of pegasus-check."""
    main(_check, CHECK, stopped="nothing was written")


def evaluate() -> None:
    """Entry point of pegasus-eval."""
    main(_evaluate, EVALUATE)


def plot() -> None:
    """Entry point of pegasus-plot."""
    main(_plot, PLOT)


def play() -> None:
    """Entry point of pegasus-play."""
    main(_play, PLAY)


def figures() -> None:
    """Entry point of pegasus-figures."""
    main(_figures, FIGURES, stopped="finished variants are kept, the same command goes on")


OPTIONS = (
    "out",
    "resume",
    "final",
    "seeds",
    "mesh",
    "distributed",
    "coordinator",
    "processes",
    "process",
)  # of pegasus-train

_begun: list[Path] = []  # the folder of what this process learns, for whoever stops it


def _train(words: Sequence[str]) -> None:
    from pegasus_jax import defaults, progress, record, settings

    options, rest = settings.split(words, OPTIONS)
    command = shlex.join(["pegasus-train", *words])
    if empty := [name for name in ("out", "resume") if options.get(name) == ""]:
        raise SettingError(f"{empty[0]}= names no folder; for example {empty[0]}=runs/demo")
    if "resume" in options:
        if wrong := sorted(
            key for key in {*rest, *options} - {"resume", "final", *OPTIONS[4:]} if not _changeable(key)
        ):
            raise SettingError(
                f"{wrong[0]} cannot be changed by resume=; only trials=, evaluation=, fit.*, search.* can, and mjcf= if"
                " the file was moved"
            )
        home = Path(options["resume"])
        runs = record.seeds_of(home)
        first = record.existing(next(iter(runs.values()), home))
        mjcf = rest.pop("mjcf", None)
        config = settings.override(settings.load(first / "config.yaml"), settings.values(rest))
        runs = runs or {config.seed: home}
    else:
        config = settings.parse(rest, options=OPTIONS)
        seeds = range(config.seed, config.seed + whole("seeds", options.get("seeds", "1")))
        name = f"seed{seeds[0]}" if len(seeds) == 1 else f"seeds{seeds[0]}-{seeds[-1]}"
        home = Path(options["out"]) if "out" in options else record.free(Path(f"runs/{defaults.label(config)}-{name}"))
        runs = {config.seed: home} if len(seeds) == 1 else {seed: home / f"seed{seed}" for seed in seeds}
    if len(runs) > 1 and config.task == defaults.GYM:
        raise SettingError(f"seeds={len(runs)} is too many for task=gym, whose environment is one object; seeds=1")
    if options.get("final", "false") not in ("true", "false"):
        raise SettingError(f"final={options['final']} is neither true nor false")
    done = len(record.readable_trials(first)[0]) if "resume" in options else None
    _begun.append(home)
    print(progress.announcement(config, home, len(runs), done), flush=True)
    _join(options)
    from pegasus_jax.program import leads, share_processors

    # Before any of the user's code, which may use JAX as soon as it is imported.
    if not {"mesh", "distributed", "coordinator"} & {*options}:
        search = config.search
        share_processors(len(runs), search.particles * search.starts if isinstance(search, Search) else None)
    over = _mesh(options.get("mesh"), len(runs))
    if leads():
        print(progress.devices(), flush=True)
    from pegasus_jax.tasks import pinned

    if "resume" in options:
        from pegasus_jax import restore

        config = restore.moved(first, config, mjcf)
        restore.announce(first, config)
    else:
        config = pinned(config)
    from pegasus_jax.build import build

    task = build(replace(config, seed=0), over).task  # so that impossible settings end here, before anything is written
    if "resume" not in options:
        from pegasus_jax import check

        for note in check.before_training(config, task, 1 if "start_mean" in rest else check.RESETS):
            print(f"note: {note}", file=sys.stderr)
    if "resume" not in options and leads():
        if record.seeds_of(home):
            raise SettingError(f"out={home} holds runs already; resume={home} goes on, out={record.free(home)} is free")
        for run in runs.values():
            record.create(run)
    from pegasus_jax.train import train_seeds

    final = options.get("final") == "true"
    train_seeds(config, runs, resume="resume" in options, command=command, final=final, mesh=over)
    if leads():
        from pegasus_jax import restore

        for seed, run in runs.items():
            told = progress.best_line(record.trials(run), restore.best(run))
            print(f"seed {seed}: {told}" if len(runs) > 1 else told)
        print(f"done: {home} (pegasus-plot {home}, pegasus-eval {next(iter(runs.values()))})")


def _check(words: Sequence[str]) -> None:
    from pegasus_jax import settings

    options, rest = settings.split(words, OPTIONS)
    if "resume" in options:
        raise SettingError(f"resume={options['resume']} was checked when it began; give the words of a new run")
    config = settings.parse(rest, options=OPTIONS)
    from pegasus_jax.check import report

    print("\n".join(report(config)))


def _changeable(key: str) -> bool:
    """Whether a run can go on with another value of this setting: what it has learned stays what it is."""
    return key in ("trials", "evaluation", "mjcf") or key.startswith(("fit.", "search."))


def _join(options: dict[str, str]) -> None:
    """Join the other processes of a study, if there are any, through jax.distributed."""
    import jax

    given = {name for name in ("coordinator", "processes", "process") if name in options}
    if not given and options.get("distributed", "false") == "false":
        return
    if given and len(given) < 3:
        raise SettingError("coordinator=HOST:PORT, processes=N and process=I (from 0) go together")
    if options.get("distributed", "true") != "true":
        raise SettingError(f"distributed={options['distributed']} is neither true nor false")
    try:
        if given:
            count, index = (whole(name, options[name]) for name in ("processes", "process"))
            jax.distributed.initialize(options["coordinator"], count, index)
        else:
            jax.distributed.initialize()  # SLURM, Open MPI and others say where the coordinator is
    except (RuntimeError, ValueError) as error:
        raise SettingError(f"distributed=true: {str(error).splitlines()[0]}; or give coordinator=HOST:PORT") from error


def _mesh(text: str | None, seeds: int) -> Any:
    """The mesh that mesh=SEEDSxPARTICLES asks for; by default as many devices as share the seeds evenly."""
    import math

    from pegasus_jax.mesh import evenly, mesh

    if text is None:
        return evenly(seeds)
    first, cross, second = text.partition("x")
    if not (cross and first.isdecimal() and second.isdecimal() and int(first) and int(second)):
        raise SettingError(f"mesh={text} is not of the form SEEDSxPARTICLES; for example mesh=4x1")
    if seeds % int(first):
        raise SettingError(
            f"mesh={text} cannot share {seeds} seeds evenly; mesh={math.gcd(seeds, int(first))}x{second}"
        )
    try:
        return mesh(int(first), int(second))
    except ValueError as error:
        raise SettingError(f"mesh={text} {error}") from error


def _evaluate(words: Sequence[str]) -> None:
    run, rest = _run_and(words, {"episodes": "20", "seed": "0", "json": "false", "trial": "last", "mjcf": ""})
    episodes, seed = (whole(name, rest[name]) for name in ("episodes", "seed"))
    if rest["json"] not in ("true", "false"):
        raise SettingError(f"json={rest['json']} is neither true nor false")
    from pegasus_jax.train import evaluate_run

    result = evaluate_run(run, episodes, seed, _trial(rest["trial"]), rest["mjcf"] or None)
    if rest["json"] == "true":
        print(json.dumps(result))
    else:
        print("\n".join(f"{name:>13}  {value}" for name, value in result.items()))


def _plot(words: Sequence[str]) -> None:
    run, _ = _run_and(words, {}, many=True)
    from pegasus_jax import record
    from pegasus_jax.report.curves import seeds_picture
    from pegasus_jax.report.plot import run_pictures

    if runs := record.seeds_of(run):
        print(seeds_picture(list(runs.values()), run / "learning.png"))
        return
    for path in run_pictures(run, record.task_of(run)):
        print(path)


def _play(words: Sequence[str]) -> None:
    run, rest = _run_and(words, {"episodes": "1", "seed": "0", "trial": "last", "mjcf": ""})
    episodes, seed = (whole(name, rest[name]) for name in ("episodes", "seed"))
    from pegasus_jax.report.play import film

    print(film(run, episodes, seed, _trial(rest["trial"]), rest["mjcf"] or None))


def _figures(words: Sequence[str]) -> None:
    from pegasus_jax import settings
    from pegasus_jax.program import share_processors
    from pegasus_jax.report import claims, comparison
    from pegasus_jax.report.figures import read
    from pegasus_jax.study import seed_list

    files = [word for word in words if "=" not in word]
    if len(files) != 1:
        raise SettingError(f"name one file, not {len(files)}; for example benchmarks/figures/crn.toml")
    options, changed = settings.split([word for word in words if "=" in word], comparison.OPTIONS)
    asked: dict[str, Any] = dict(seeds=options.get("seeds", ""), changes=[f"{k}={v}" for k, v in changed.items()])
    only = [label for label in options.get("variants", "").split(",") if label]
    figure, out = read(Path(files[0])), Path(options.get("out", "runs/figures"))
    share_processors(len(seed_list(asked["seeds"] or figure.seeds)))
    there = comparison.run(figure, out, only=only, command=shlex.join(["pegasus-figures", *words]), **asked)
    for line in comparison.differences(figure, there, **asked):
        print(line, file=sys.stderr)
    print(claims.markdown(claims.variants_table(figure, out)))
    if figure.claims:
        print(f"\n{claims.markdown(claims.claims_table(figure, out))}")
    print(comparison.draw(figure, there, out))


def _run_and(words: Sequence[str], defaults: dict[str, str], many: bool = False) -> tuple[Path, dict[str, str]]:
    """The run's folder, or with `many` maybe that of several seeds, and the options of a command that reads it."""
    from pegasus_jax import record, settings
    from pegasus_jax.checks import nearest

    named = [word for word in words if "=" not in word]
    if len(named) != 1:
        raise SettingError(f"name one run, not {len(named)}; for example runs/cartpole-seed0")
    _, rest = settings.split([word for word in words if "=" in word])
    for key in rest:
        if key not in defaults:
            raise SettingError(
                f"{key} is not an option here; {nearest(key, defaults) if defaults else 'there are none'}"
            )
    path = Path(named[0])
    if runs := record.seeds_of(path):
        if not many:
            raise SettingError(f"{path} holds the runs of {len(runs)} seeds; name one, for example {runs[min(runs)]}")
        return path, defaults | rest
    return record.existing(path), defaults | rest


def whole(name: str, text: str) -> int:
    """The whole number of an option. Raises SettingError when it is none, or 0 where nothing would be done."""
    if not text.isdecimal() or (name in ("episodes", "seeds", "jobs") and int(text) < 1):
        raise SettingError(f"{name}={text} is not a whole number; for example {name}=20")
    within(name, int(text), 0, 2**32 - 1 if name == "seed" else SIZES["trials"])
    return int(text)


def _trial(text: str) -> int | str:
    """The trial whose policy is asked for. Raises SettingError for a text that names none."""
    if text in ("last", "best"):
        return text
    if not text.isdecimal():
        raise SettingError(f"trial={text} is not a trial; expected a number, best or last")
    return int(text)


HELP = {"-h", "--help", "help"}


def _help(text: str, words: Sequence[str]) -> str:
    """A command's help; of its settings as these words leave them. Raises SettingError for words that cannot be."""
    if "{settings}" not in text:
        return text
    from pegasus_jax import settings
    from pegasus_jax.defaults import NAMES
    from pegasus_jax.variants import ALGORITHMS, KINDS, MODELS, POLICIES

    named = dict(tasks=NAMES, models=MODELS, policies=POLICIES, algorithms=ALGORITHMS)
    lists = {name: ", ".join(values) for name, values in named.items()}
    _, dotted = settings.split([word for word in words if word not in HELP], OPTIONS)
    config = settings.parse(dotted, OPTIONS)
    others = [
        f"\nwith {section}.kind={kind}, chosen by model=, policy= or algorithm=\n"
        + "\n".join(settings.help_lines(default, f"{section}."))
        + "\n"
        for section, kinds in KINDS.items()
        for kind, default in kinds.items()
        if kind != getattr(config, section).kind
    ]
    return text.format(settings="\n".join(settings.help_lines(config)), others="".join(others), **lists)


def main(
    command: Callable[[Sequence[str]], None],
    text: str,
    stopped: str = "nothing was learned",
) -> None:
    """Run a command: 0 done, 2 a setting or a run's folder that cannot be, in one line, 130 after Ctrl-C.

    Whatever ends it, a robot is let go first, and no thread that still compiles is waited for.
    """
    words = sys.argv[1:]
    interrupt.before_end(_let_robots_go)
    try:
        interrupt.listen()
        code = _code(command, words, text)
    except KeyboardInterrupt:
        interrupt.clean_up()
        print(_stopped(_begun[0]) if _begun else f"stopped; {stopped}", file=sys.stderr)
        code = interrupt.status()
    except BaseException:
        interrupt.clean_up()
        raise
    interrupt.clean_up()
    interrupt.end(code)


def _stopped(home: Path) -> str:
    from pegasus_jax.progress import stopped

    return stopped(home)


def _let_robots_go() -> None:
    """Close every environment that is open."""
    if "pegasus_jax.tasks" in sys.modules:  # else none can be
        from pegasus_jax.tasks import close_environments

        close_environments()


def _code(command: Callable[[Sequence[str]], None], words: Sequence[str], text: str) -> int:
    """The exit status of a command that nobody stopped."""
    from pegasus_jax.checks import RunError

    try:
        words = [*words, *(_always() if words and command in (_train, _figures) else ())]
        if not words or HELP & {*words}:
            print(_help(text, words), end="")
            return 0 if words else 2
        _remember_compilations()
        command(words)
    except (SettingError, RunError) as error:
        interrupt.clean_up()
        print(f"pegasus: {error}", file=sys.stderr)
        return 2
    except OSError as error:
        interrupt.clean_up()
        print(f"pegasus: {files.refused(error)}{_goes_on()}", file=sys.stderr)
        return 2
    return 0


def _goes_on() -> str:
    """How to go on with what was begun."""
    return f"; every finished episode is kept, resume={_begun[0]} goes on" if _begun else ""


def _always() -> list[str]:
    """The words of PEGASUS_SETTINGS, which come after those that were typed."""
    text = os.environ.get("PEGASUS_SETTINGS", "")
    try:
        return shlex.split(text)
    except ValueError as error:
        raise SettingError(f"PEGASUS_SETTINGS={text} cannot be read: {error}; expected key=value words") from error


def _remember_compilations() -> None:
    """Keep compiled programs in the user's cache folder, unless JAX, which is not imported yet, is told where.

    In none that is unsafe.
    """
    folder = os.environ.get("JAX_COMPILATION_CACHE_DIR", cache.folder())
    if not folder or "://" in folder:
        return
    if problem := cache.problem(Path(folder)):
        print(f"{folder} {problem}; programs are compiled as if for the first time", file=sys.stderr)
        os.environ["JAX_ENABLE_COMPILATION_CACHE"] = "false"
    elif "JAX_COMPILATION_CACHE_DIR" not in os.environ:
        os.environ["JAX_COMPILATION_CACHE_DIR"] = folder
        os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0.2")
