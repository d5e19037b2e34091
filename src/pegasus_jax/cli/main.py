"""The commands pegasus-train, -check, -eval, -plot and -play: `key=value` words in, an exit status out."""

import gc
import io
import os
import sys
from collections.abc import Callable, Sequence
from pathlib import Path

from pegasus_jax import interrupt
from pegasus_jax.checks import ConfigError, RunError
from pegasus_jax.cli import help, runs, version
from pegasus_jax.cli import train as cli_train
from pegasus_jax.runs import cache, files
from pegasus_jax.runs.removed import renamed
from pegasus_jax.shell import split

Always = Callable[[], Sequence[str]]


def train() -> None:
    """Entry point of pegasus-train."""
    main(cli_train.train, help.TRAIN, always=_always)


def check() -> None:
    """Entry point of pegasus-check."""
    main(cli_train.check, help.CHECK, stopped="nothing was written")


def evaluate() -> None:
    """Entry point of pegasus-eval."""
    main(runs.evaluate, help.EVALUATE)


def plot() -> None:
    """Entry point of pegasus-plot."""
    main(runs.plot, help.PLOT)


def play() -> None:
    """Entry point of pegasus-play."""
    main(runs.play, help.PLAY)


def figures() -> None:
    """Entry point of pegasus-figures, which left the package: its experiments and results are in benchmarks/."""
    print("pegasus: pegasus-figures is now python -m benchmarks.paper, in a checkout of pegasus_jax", file=sys.stderr)
    sys.exit(2)


def main(
    command: Callable[[Sequence[str]], None],
    text: str,
    stopped: str = "nothing was learned",
    always: Always = lambda: (),
) -> None:
    """Run a command: 0 done, 2 what cannot be or a robot that did not close, in one line, 130 after Ctrl-C.

    `always` are words that come after those that were typed, if any were.
    Whatever ends it, environments are closed first, and threads that still compile are not waited for.
    """
    # What JAX makes when it traces stays: to look for garbage in it so often took a tenth of a short run's time.
    gc.set_threshold(100_000)
    words = sys.argv[1:]
    _write_what_can_be()
    interrupt.before_end(_let_robots_go)
    try:
        interrupt.listen()
        code = _code(command, words, text, always)
    except BaseException as error:
        interrupt.clean_up()
        if interrupt.asked() or isinstance(error, KeyboardInterrupt):
            print(_stopped(cli_train.begun[0]) if cli_train.begun else f"stopped; {stopped}", file=sys.stderr)
            code = interrupt.status()
        elif isinstance(error, SystemExit):
            raise
        else:  # a defect: told whole, without the crash of compiling threads that Python's own end brings
            sys.excepthook(*sys.exc_info())  # type: ignore[arg-type]
            code = 1
    interrupt.clean_up()
    interrupt.end(code)


def _write_what_can_be() -> None:
    """A letter that the output has no code for, as pipes of Windows for Greek ones, is no error: \\u03b8 is written."""
    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(errors="backslashreplace")


def _stopped(home: Path) -> str:
    from pegasus_jax.runs.display import stopped

    return stopped(home)


def _let_robots_go() -> None:
    """Close every environment that is open."""
    if "pegasus_jax.tasks" in sys.modules:  # else none can be
        from pegasus_jax.tasks import close_environments

        close_environments()


def _code(
    command: Callable[[Sequence[str]], None], words: Sequence[str], text: str, always: Always = lambda: ()
) -> int:
    """The exit status of a command that nobody stopped."""
    try:
        added = always() if words else ()  # they may change what was typed
        typed, words = words, _of_today([*words, *added])
        if not words or help.asked(words):
            print(help.help_of(text, words), end="")
            return 0 if words else 2
        if version.asked(words):
            print(version.told(words))
            return 0
        _once(typed)
        _once(added)
        _remember_compilations()
        command(words)
    except (ConfigError, RunError) as error:
        interrupt.clean_up()
        print(f"pegasus: {error}", file=sys.stderr)
        return 2
    except OSError as error:
        interrupt.clean_up()
        print(f"pegasus: {files.refused(error)}{_goes_on()}", file=sys.stderr)
        return 2
    return 0


def _of_today(words: Sequence[str]) -> list[str]:
    """The words with today's names of settings: a script that has an old one works, and is told the new one."""
    today, answers = renamed(words)
    for answer in answers:
        print(f"note: {answer}", file=sys.stderr)
    return today


def _once(words: Sequence[str]) -> None:
    """Raises ConfigError for a word that is given twice, whatever it is given. Folders may have a = in their names."""
    given: dict[str, list[str]] = {}
    for word in words:
        key, equals, _ = word.partition("=")
        if equals:
            given.setdefault(key, []).append(word)
    for key, every in given.items():
        if len(every) > 1 and not all(map(os.path.exists, every)):
            raise ConfigError(f"{key}= is given {len(every)} times, {' and '.join(every)}; give it once")


def _goes_on() -> str:
    """How to go on with what was begun."""
    return f"; all rows of every episode are kept, resume={cli_train.begun[0]} goes on" if cli_train.begun else ""


def _always() -> list[str]:
    """The words of PEGASUS_SETTINGS, which come after those that were typed."""
    text = os.environ.get("PEGASUS_SETTINGS", "")
    try:
        return split(text)
    except ValueError as error:
        raise ConfigError(f"PEGASUS_SETTINGS={text} cannot be read: {error}; expected settings, as trials=2") from error


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
