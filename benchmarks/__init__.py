"""Measurements; benchmarks/README.md says what each command measures."""

import json
import os
import shlex
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from pathlib import Path
from typing import Any, TypeVar

from pegasus_jax import interrupt
from pegasus_jax.checks import ConfigError, RunError, did_you_mean
from pegasus_jax.cli import help

RESULTS = Path(__file__).parent / "results"
T = TypeVar("T")
Run = dict[str, Any]  # what is kept of one, in a file of results


def command(main: Callable[[list[str]], int | None], what: str | None) -> None:
    """Run a benchmark with the words of its command line; `--help` prints `what`, the docstring of its module.

    What cannot be run, and a file that cannot be read or written, is one line and the exit status 1; Ctrl-C is 130.
    """
    words, name = sys.argv[1:], _name(Path(sys.argv[0]))
    try:
        if help.asked(words):
            print(what, flush=True)
            return
        status = main(words)
        sys.stdout.flush()
    except (ConfigError, RunError) as error:
        sys.exit(f"{name}: {error}")
    except BrokenPipeError:  # nobody reads it any more, as after `| head -1`
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        sys.exit(1)
    except OSError as error:
        from pegasus_jax.runs.files import refused  # here: as in `only`

        sys.exit(f"{name}: {refused(error)}")
    except KeyboardInterrupt:
        print(f"{name}: stopped", file=sys.stderr)
        interrupt.end(130)  # a compiling thread would be waited for, and then abort the process
    if status:
        sys.exit(status)


def _name(file: Path) -> str:
    return file.parent.name if file.stem in ("__main__", "__init__") else file.stem


def named(words: list[str], what: str) -> tuple[str, list[str]]:
    """The first word of a command, which names something, and the others. Raises ConfigError where it does not."""
    if not words or "=" in words[0]:
        raise ConfigError(f"the first word is missing; expected {what}")
    return words[0], words[1:]


def only(words: Sequence[str], names: Sequence[str]) -> dict[str, str]:
    """The options of a command that takes no settings. Raises ConfigError for any other word."""
    from pegasus_jax.runs import config_io  # here: what this module imports, every measured process waits for

    options, others = config_io.split(words, names)
    for name in others:
        raise ConfigError(f"{name}= is unknown; {did_you_mean(name, names)}")
    return options


def none(words: Sequence[str]) -> None:
    """Raises ConfigError where a command that takes no words is given one."""
    if words:
        raise ConfigError(f"{words[0]} is one word too many; expected none")


def number(options: Mapping[str, str], name: str, default: int, least: int = 1) -> int:
    """An option that is a whole number. Raises ConfigError for another, and for one below `least`."""
    return _number(name, options.get(name, str(default)), default, least)


def numbers(options: Mapping[str, str], name: str, default: str) -> list[int]:
    """An option that is whole numbers from 1 on, with commas between them. Raises ConfigError for any other."""
    return [_number(name, text, default, 1) for text in options.get(name, default).split(",")]


def _number(name: str, text: str, example: object, least: int) -> int:
    if not (text.isdecimal() and len(text) < 10 and int(text) >= least):
        raise ConfigError(f"{name}={text} is not a whole number from {least} on; for example {name}={example}")
    return int(text)


def minutes(options: Mapping[str, str], default: float) -> float:
    """The option of this name [min]. Raises ConfigError unless it is a number above 0."""
    text = options.get("minutes", f"{default:g}")
    try:
        if 0 < (value := float(text)) < float("inf"):
            return value
    except ValueError:
        pass
    raise ConfigError(f"minutes={text} is not a number above 0; for example minutes={default:g}")


def writable(out: str | Path) -> Path:
    """The file of an option out=, in a folder that is there now. Raises ConfigError where no file can be written.

    To be called before the work: what was measured for minutes is to find its place.
    """
    path = Path(out)
    path.parent.mkdir(parents=True, exist_ok=True)
    if path.is_dir() or not os.access(path if path.exists() else path.parent, os.W_OK):
        raise ConfigError(f"out={out} cannot be written; expected the name of a file")
    return path


def unfinished(path: Path) -> Path:
    """The file of a study that is to be learned. Raises ConfigError where one is that came to its end: it has `about`.

    Hours of work are not replaced by the slip of a keyboard, nor is a file of something else.
    """
    if path.exists():
        try:
            ended = "about" in (study := json.loads(path.read_text(encoding="utf-8"))) or "seeds" not in study
        except (ValueError, TypeError):
            ended = True
        if ended:
            raise ConfigError(f"{path} is there; expected the name of a new file, or that you move this one away")
    return writable(path)


def written(path: str | Path, by: str, parts: Callable[[Any], T]) -> T:
    """The parts of a file that the module `by` of benchmarks wrote. Raises ConfigError for one without them."""
    try:
        return parts(json.loads(Path(path).read_text(encoding="utf-8")))
    except (ValueError, KeyError, TypeError) as error:
        raise ConfigError(f"{path} is not what python -m benchmarks.{by} writes") from error


def once(*words: object) -> list[str]:
    """The words of a command, which takes each once: of those that are there twice the last."""
    return list({word.partition("=")[0]: word for word in map(str, words)}.values())


def beside_runs(out: str, words: Sequence[str]) -> tuple[Path, Path, list[Run]]:
    """(file of the results, folder of the runs that they are of, the results that are there) of a command.

    The folder remembers the settings of its runs, `words`: a run that goes on keeps them, so other ones need another
    file. Raises ConfigError for those, for a name that does not end in .json, and for a file of something else.
    """
    path = Path(out).absolute()
    if path.suffix != ".json":
        raise ConfigError(f"out={out} is a folder's name; expected that of a file: out={out}.json")
    home, there = path.with_suffix(""), stored_runs(path)
    home.mkdir(parents=True, exist_ok=True)
    made, now = home / "settings.txt", shlex.join(sorted(words))
    if not made.exists():
        made.write_text(now + "\n", encoding="utf-8")
    elif (before := made.read_text(encoding="utf-8").strip()) != now:
        raise ConfigError(f"out={out} has runs of other settings, {before or 'none'}; expected those, or another out=")
    return path, home, there


def stored_runs(path: Path) -> list[Run]:
    """The runs that a file of results has, if it is there. Raises ConfigError for a file of something else."""
    try:
        return [*map(dict, json.loads(path.read_text(encoding="utf-8"))["runs"])]
    except FileNotFoundError:
        return []
    except (ValueError, KeyError, TypeError):
        raise ConfigError(
            f"out={path} has no runs of this command; expected a new file, or one that it wrote"
        ) from None


def each(jobs: int, calls: Iterable[Callable[[], T]]) -> Iterator[T]:
    """What the calls return, `jobs` of them at a time, each as soon as it is there. After Ctrl-C none is begun."""
    with ThreadPoolExecutor(jobs) as pool:
        try:
            for job in as_completed([pool.submit(call) for call in calls]):
                yield job.result()
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)
            raise
