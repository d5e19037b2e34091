"""The command line's `key=value` words -> a checked Config, through OmegaConf's structured configs."""

import dataclasses
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException
from yaml import YAMLError

from pegasus_jax.checks import FUNCTION, ConfigError, did_you_mean, expected, shown
from pegasus_jax.config import KINDS, TASKS, Config, check_spread, uses
from pegasus_jax.config_models import sized
from pegasus_jax.config_used import check_needed, check_used, leaves
from pegasus_jax.presets import FOR_ANY, WORDS, own, preset
from pegasus_jax.runs.files import write_whole
from pegasus_jax.runs.removed import refuse, today

# Keys that select what a command begins with, and what they select from.
NAMED: dict[str, Any] = {"task": TASKS, **WORDS}
ONE_FOR_ALL = ("control_rate",)  # settings of numbers, or of one number for all
ARGUMENTS = "env_args."  # NAME=VALUE of an environment's own
FILES = ("data",)  # settings of files and patterns: one, or a list of them; * means something else in YAML


def split(words: Sequence[str], options: Sequence[str] = ()) -> tuple[dict[str, str], dict[str, str]]:
    """(options, settings) of `key=value` words. Raises ConfigError for a word that is not of that form."""
    known, rest = {}, {}
    for word in words:
        key, equals, value = word.partition("=")
        if not equals or not key:
            if any(part.startswith("=") or part.endswith("=") for part in words):
                raise ConfigError(
                    f"'{word}' is not of the form key=value; write no spaces around =, as in task=cartpole"
                )
            placed = {
                value: f"{name}={value}" for name in reversed(NAMED) for value in NAMED[name]
            }  # task= before others
            choices = [*options, *NAMED, *leaves(Config()), *placed.values(), "help"]
            bare = word.lstrip("-")
            raise ConfigError(f"'{word}' is not of the form key=value; {_hint(placed.get(bare, bare), choices)}")
        (known if key in options else rest)[key] = value
    return known, rest


def parse(words: Mapping[str, Any], options: Sequence[str] = ()) -> Config:
    """The config of a command line: a preset, the sections that words replace, then the dotted settings.

    The words are texts, from Python maybe values.
    """
    words = without_random(_with_arguments(words))
    chosen = {name: words.pop(name) for name in NAMED if name in words}
    for name, value in chosen.items():
        if value not in NAMED[name]:
            raise ConfigError(f"{name}={value} is unknown; {did_you_mean(value, NAMED[name])}")
    given = {key: words[key] for key in ("legs",) if key in words}
    task, begin = chosen.pop("task", None), chosen.pop("preset", None)
    if begin is None:
        task = task or Config.task
        begin = own(task, override(Config(task=task), values(given)).legs if uses(task, "legs") else Config.legs)
    config = preset(begin, **chosen)
    if begin in FOR_ANY:
        config = override(config, values(given) | ({} if task is None else {"task": task}))
    if task not in (None, config.task):
        raise ConfigError(f"preset={begin} is for task={config.task}, not task={task}; the nearest is preset={task}")
    known = leaves(config)
    for key in words:
        refuse(key)
        if key not in known:
            raise unknown(key, [*known, *NAMED, *options])
        check_used(config.task, {key: words[key]})
    changed = override(config, values(words))
    check_needed(changed, words)
    if "start_std" in words:
        check_spread(changed)
    if changed.legs != config.legs:
        raise ConfigError(f"preset={begin} is for legs={config.legs}; with legs={changed.legs} leave out preset=")
    return changed


def _with_arguments(words: Mapping[str, Any]) -> dict[str, Any]:
    """The words, with those of env_args.NAME=VALUE as one list; a value that is no text is there in JSON."""
    texts = {key: text if isinstance(text, str) else _json(key, text) for key, text in words.items() if _argument(key)}
    rest = {key: value for key, value in words.items() if not _argument(key)}
    return rest | (
        {"env_args": [f"{key.removeprefix(ARGUMENTS)}={text}" for key, text in texts.items()]} if texts else {}
    )


def of_python(words: Mapping[str, Any]) -> dict[str, Any]:
    """The words of a Python program: what it gives an environment is what it gets, also the text "5".

    The environment's arguments may be {"env_args.port": 5} or {"env_args": {"port": 5}}.
    """
    if isinstance(own := words.get("env_args"), Mapping):
        words = {key: value for key, value in words.items() if key != "env_args"} | {
            f"{ARGUMENTS}{name}": value for name, value in own.items()
        }
    return _with_arguments({key: _json(key, value) if _argument(key) else value for key, value in words.items()})


def _argument(key: str) -> bool:
    return key.startswith(ARGUMENTS)


def _json(key: str, value: Any) -> str:
    """A value as JSON. Raises ConfigError for one that no file of settings can hold."""
    try:
        return json.dumps(value, ensure_ascii=False, default=lambda array: array.tolist())
    except (AttributeError, TypeError, ValueError) as error:
        raise ConfigError(
            f"{key} is of type {type(value).__name__}, which a run's folder cannot keep; expected a number, a text,"
            " True, False, None, or a list or a dict of these"
        ) from error


def without_random(words: Mapping[str, Any]) -> dict[str, Any]:
    """The words, with no random episode unless they ask for some, where there is a first policy or a simulator."""
    if "explore.policy" in words:  # which is to drive some
        return dict(words)
    parts = str(words.get("init_parts", "policy"))
    knows = words.get("prior") not in (None, "null") or (words.get("init") not in (None, "null") and "policy" in parts)
    return ({"explore.trials": 0} if knows else {}) | dict(words)


def values(words: Mapping[str, Any]) -> dict[str, Any]:
    """What the texts on the right of `key=` mean, read as YAML; what is no text is a value already, maybe NumPy's."""
    return {key: _value(key, text) if isinstance(text, str) else _of_numpy(text) for key, text in words.items()}


def _of_numpy(value: Any) -> Any:
    """The value, whose numbers and arrays of NumPy or JAX are Python's numbers and lists of them."""
    if isinstance(value, list | tuple):
        return [*map(_of_numpy, value)]
    try:
        return value.tolist()
    except AttributeError:
        return value


def override(config: Config, changes: dict[str, Any]) -> Config:
    """The config with dotted settings changed, all at once; each value becomes its setting's type, or is refused."""
    known = leaves(config)
    for key in changes:
        refuse(key)
        if key not in known:
            raise unknown(key, [*known])
    return _changed(config, changes, "")


def plain(config: Config) -> dict[str, Any]:
    """`leaves` as YAML and JSON have them: with lists, not tuples, and a function by its name."""
    return {
        name: list(value) if isinstance(value, tuple) else shown(value) if callable(value) else value
        for name, value in leaves(config).items()
    }


def described(node: Any, prefix: str = "") -> dict[str, tuple[str, str]]:
    """Setting -> name=default and what it is for; without those that select what a command begins with."""
    found: dict[str, tuple[str, str]] = {}
    for f in dataclasses.fields(node):
        value, name = getattr(node, f.name), prefix + f.name
        if dataclasses.is_dataclass(value):
            found |= described(value, f"{name}.")
        elif name not in NAMED and f.metadata["help"]:
            found[name] = (f"{name}={shown(value)}", f.metadata["help"])
    return found


def numbered(config: Config, states: int) -> Config:
    """The config of a plant of so many states, with a number for each null of its model: a later version may choose
    other numbers, and a run goes on with those that it began with.
    """
    return dataclasses.replace(config, model=sized(config.model, states))


def save(config: Config, path: Path) -> None:
    """Write the resolved config as YAML that `load` reads; the file appears whole or not at all."""
    text = OmegaConf.to_yaml(OmegaConf.create(plain(config)))
    write_whole(path, lambda file: file.write(text.encode()))


def load(path: Path) -> Config:
    """The config that `save` wrote. Raises ConfigError when it is not one."""
    try:
        stored: Any = OmegaConf.to_container(OmegaConf.load(path), resolve=False)
    except (OSError, ValueError, RecursionError, OmegaConfBaseException, YAMLError) as error:
        raise ConfigError(f"{path} cannot be read: {' '.join(str(error).split())}") from error
    if not isinstance(stored, dict) or "task" not in stored:
        raise ConfigError(f"{path} is not the config of a run")
    try:
        return stored_config({str(key): value for key, value in stored.items()})
    except ConfigError as error:
        raise ConfigError(f"{path}: {error}") from error


def stored_config(stored: dict[str, Any]) -> Config:
    """The config of which `plain` was kept. Raises ConfigError for a name or a value that no setting has.

    A setting that is not there is younger than what was kept, and its default leaves everything as it was.
    """
    chosen = {section: stored.get(f"{section}.kind") for section in KINDS}
    for section, kind in chosen.items():
        if kind not in (None, *KINDS[section]):
            raise ConfigError(f"{section}.kind={kind} is unknown; {did_you_mean(kind, KINDS[section])}")
    config = Config(**{section: KINDS[section][kind] for section, kind in chosen.items() if kind is not None})
    stored = today(stored)
    if wrong := sorted(set(stored) - set(leaves(config))):
        raise ConfigError(f"not the config of a run of this version: see {', '.join(wrong[:5])}")
    return override(config, stored)


def misspelt(key: str, options: Sequence[str]) -> ConfigError | None:
    """What to say of a word's key that is no setting of any kind, none of the options and no preset's; else None."""
    every = [*leaves(Config()), *NAMED, *options]
    return None if key in every or _argument(key) or _of_others(key) else unknown(key, every)


def unknown(key: str, choices: Sequence[str]) -> ConfigError:
    """What to say of a key that is none of the choices."""
    return ConfigError(f"{key} is not a setting{_of_others(key)}; {_hint(key, choices)}")


def _of_others(key: str) -> str:
    """Of a setting that other kinds of its section have, which these are; "" of one that none has."""
    section = key.partition(".")[0]
    owners = [name for name, kind in KINDS.get(section, {}).items() if key in leaves(kind, f"{section}.")]
    return f" here, but of {section}.kind={' or '.join(owners)}" if owners else ""


def _hint(key: str, choices: Sequence[str]) -> str:
    """The nearest choice; all of them only when they are few."""
    text = did_you_mean(key, choices).removesuffix(f"choices: {', '.join(choices)}")
    return f"{text}--help=all lists all settings"


def _value(key: str, text: str) -> Any:
    if key in FILES:
        inner = text[1:-1] if text.startswith("[") and text.endswith("]") else text
        return [name.strip() for name in inner.split(",") if name.strip()]
    try:
        return OmegaConf.to_container(OmegaConf.from_dotlist([f"value={text}"]))["value"]  # type: ignore[index,call-overload]
    except Exception as error:
        quoted = f'; quote what has spaces or brackets, as in \'{key}=["a [m]","b"]\'' if "[" in text else ""
        raise ConfigError(f"{key}={shown(text)} cannot be read as a value{quoted}") from error


def _changed(node: Any, changes: dict[str, Any], prefix: str) -> Any:
    """A copy of the dataclass with dotted fields changed together: some limit each other."""
    here: dict[str, Any] = {}
    below: dict[str, dict[str, Any]] = {}
    for key, value in changes.items():
        head, _, rest = key.partition(".")
        if rest:
            below.setdefault(head, {})[rest] = value
        else:
            here[head] = _converted(node, head, value, prefix + head)
    here |= {head: _changed(getattr(node, head), inner, f"{prefix}{head}.") for head, inner in below.items()}
    return dataclasses.replace(node, **here)


def _same(value: Any, current: Any) -> bool:
    """Whether a value is what a setting has, its type too; a list is the tuple of its entries, as `plain` made it."""
    if isinstance(value, list) and isinstance(current, tuple):
        return len(value) == len(current) and all(map(_same, value, current))
    return isinstance(value, str | int | float | None) and (type(value), value) == (type(current), current)


def _converted(node: Any, name: str, value: Any, key: str) -> Any:
    """The value as the type of the dataclass's field of that name."""
    if "${" in str(value):  # OmegaConf would put another setting there, or a variable of the environment
        raise ConfigError(f"{key}={shown(value)} is not a value but a reference to one; write the value itself")
    current = getattr(node, name)
    if _same(value, current):
        return current  # OmegaConf would take 2 ms to find that out, for each of the settings that a run has kept
    if key in ONE_FOR_ALL and isinstance(value, int | float) and not isinstance(value, bool):
        value = [value]
    field = next(f for f in dataclasses.fields(node) if f.name == name)
    if callable(value):
        return value  # from Python: the config says whether it can be one
    kind, default = (str | None, None) if field.type == FUNCTION else (field.type, current)  # in words, its name
    schema = OmegaConf.structured(dataclasses.make_dataclass("One", [(name, kind, default)]))
    try:
        merged = OmegaConf.merge(schema, {name: value})
        assert isinstance(merged, DictConfig)
        return getattr(OmegaConf.to_object(merged), name)
    except (OmegaConfBaseException, AssertionError, TypeError, ValueError) as error:
        raise ConfigError(f"{key}={shown(value)} is not {expected(key, field.type, value, current)}") from error
