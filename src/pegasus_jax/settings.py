"""The command line's `key=value` words -> a checked Config, through OmegaConf's structured configs."""

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from pegasus_jax import tasks
from pegasus_jax.config import ALGORITHMS, MODELS, POLICIES, Config, SettingError, nearest

# Keys that select a named variant, and what they select from.
VARIANTS: dict[str, Any] = {"task": tasks.NAMES, "model": MODELS, "policy": POLICIES, "algorithm": ALGORITHMS}


def split(words: Sequence[str], options: Sequence[str] = ()) -> tuple[dict[str, str], dict[str, str]]:
    """(options, settings) of `key=value` words. Raises SettingError for a word that is not of that form."""
    known, rest = {}, {}
    for word in words:
        key, equals, value = word.partition("=")
        if not equals or not key:
            choices = [*options, *VARIANTS, *leaves(Config())]
            raise SettingError(f"'{word}' is not of the form key=value; {_hint(word.lstrip('-'), choices)}")
        (known if key in options else rest)[key] = value
    return known, rest


def parse(words: dict[str, str], options: Sequence[str] = ()) -> Config:
    """The config of a command line: defaults, then the variants' and the task's, then the dotted settings."""
    words = dict(words)
    chosen = {name: words.pop(name) for name in VARIANTS if name in words}
    for name, value in chosen.items():
        if value not in VARIANTS[name]:
            raise SettingError(f"{name}={value} is unknown; {nearest(value, VARIANTS[name])}")
    config = Config(
        task=chosen.get("task", Config.task),
        model=MODELS.get(chosen.get("model", ""), Config.model),
        policy=POLICIES.get(chosen.get("policy", ""), Config.policy),
    )
    config = override(config, values({key: words[key] for key in ("legs",) if key in words}))
    config = override(config, tasks.defaults(config.task, config.legs))
    config = override(config, ALGORITHMS[chosen.get("algorithm", "pegasus")])
    known = leaves(config)
    for key in words:
        if key not in known:
            raise SettingError(f"{key} is not a setting; {_hint(key, [*known, *VARIANTS, *options])}")
    return override(config, values(words))


def values(words: dict[str, str]) -> dict[str, Any]:
    """What the texts on the right of `key=` mean, read as YAML."""
    return {key: _value(key, text) for key, text in words.items()}


def override(config: Config, changes: dict[str, Any]) -> Config:
    """The config with dotted settings changed; each value is converted to its setting's type, or refused."""
    for key, value in changes.items():
        head, _, rest = key.partition(".")
        if not rest:
            config = _replaced(config, key, value, key)
            continue
        section = _replaced(getattr(config, head), rest, value, key)
        config = dataclasses.replace(config, **{head: section})
    return config


def leaves(node: Any, prefix: str = "") -> dict[str, Any]:
    """Dotted name -> value of every setting under a config dataclass."""
    found: dict[str, Any] = {}
    for f in dataclasses.fields(node):
        value = getattr(node, f.name)
        if dataclasses.is_dataclass(value):
            found |= leaves(value, f"{prefix}{f.name}.")
        else:
            found[prefix + f.name] = value
    return found


def help_lines(node: Any, prefix: str = "") -> list[str]:
    """One line a setting: name=default and what it is for."""
    lines: list[str] = []
    for f in dataclasses.fields(node):
        value = getattr(node, f.name)
        if dataclasses.is_dataclass(value):
            lines += help_lines(value, f"{prefix}{f.name}.")
        elif f"{prefix}{f.name}" not in VARIANTS:
            lines.append(f"  {prefix + f.name + '=' + _text(value):34s} {f.metadata.get('help', '')}")
    return lines


def save(config: Config, path: Path) -> None:
    """Write the resolved config as YAML that `load` reads."""
    OmegaConf.save(
        OmegaConf.create({k: list(v) if isinstance(v, tuple) else v for k, v in leaves(config).items()}), path
    )


def load(path: Path) -> Config:
    """The config that `save` wrote. Raises SettingError when it is not one."""
    try:
        stored = OmegaConf.to_container(OmegaConf.load(path))
        assert isinstance(stored, dict)
        config = Config(task=stored.pop("task", Config.task))
        unknown = set(stored) - set(leaves(config))
        if unknown:
            raise SettingError(f"{path}: unknown settings {', '.join(sorted(map(str, unknown)))}")
        return override(config, {str(k): v for k, v in stored.items()})
    except (OSError, AssertionError, OmegaConfBaseException) as error:
        raise SettingError(f"{path} is not the config of a run: {error}") from error


def _hint(key: str, choices: Sequence[str]) -> str:
    """The nearest choice; all of them only when they are few."""
    text = nearest(key, choices).removesuffix(f"choices: {', '.join(choices)}")
    return f"{text}--help lists all settings"


def _value(key: str, text: str) -> Any:
    try:
        return OmegaConf.to_container(OmegaConf.from_dotlist([f"value={text}"]))["value"]  # type: ignore[index,call-overload]
    except Exception as error:
        raise SettingError(f"{key}={text} cannot be read as a value") from error


def _replaced(node: Any, name: str, value: Any, key: str) -> Any:
    """A copy of the dataclass with one (possibly nested) field set to a converted value."""
    head, _, rest = name.partition(".")
    current = getattr(node, head)
    if rest:
        return dataclasses.replace(node, **{head: _replaced(current, rest, value, key)})
    if dataclasses.is_dataclass(current) and isinstance(value, dict):
        return dataclasses.replace(node, **{head: dataclasses.replace(current, **value)})  # type: ignore[type-var]
    field = next(f for f in dataclasses.fields(node) if f.name == head)
    schema = OmegaConf.structured(dataclasses.make_dataclass("One", [(head, field.type, current)]))
    try:
        merged = OmegaConf.merge(schema, {head: value})
        assert isinstance(merged, DictConfig)
        converted = OmegaConf.to_object(merged)
    except OmegaConfBaseException as error:
        raise SettingError(
            f"{key}={_text(value)} is not {_kind(field.type)}; for example {key}={_text(current)}"
        ) from error
    converted = getattr(converted, head)
    return dataclasses.replace(node, **{head: converted})


def _kind(annotation: Any) -> str:
    return {
        int: "a whole number",
        float: "a number",
        bool: "true or false",
        str: "a word",
        tuple[int, ...]: "a list of whole numbers",
        str | None: "a word or null",
        int | None: "a whole number or null",
    }.get(annotation, "a number or null")


def _text(value: Any) -> str:
    if value is None:
        return "null"
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, tuple | list):
        return "[" + ",".join(map(str, value)) + "]"
    return f"{value:g}" if isinstance(value, float) else str(value)
