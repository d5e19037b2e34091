"""Comparisons of learning curves as data: a TOML file says what varies, over which seeds and how many trials.

title = "Gradient clipping"
paper = "What the paper says about it, in one paragraph."       # optional
found = "What these studies say to that, in one more."          # optional
seeds = "0-9"
trials = 15
picture = "area"                                                # optional; "curves" if left out
common = "algorithm=paper"                                      # settings of every variant, as on a command line

[variants]                                                      # label = its own settings
none = "search.grad_clip=null"
"1" = "search.grad_clip=1"

[[claims]]                                                      # optional: what the numbers should show
says = "clipping beats none"
lower = "1"                                                     # these have the lower cost ...
than = "none"                                                   # ... than this variant, or than a published number
trials = [1, 15]                                                # mean over so many trials; from and to
"""

import re
import tomllib
from pathlib import Path
from typing import Any, NamedTuple

from pegasus_jax.checks import ConfigError, did_you_mean


class Claim(NamedTuple):
    """One comparison of mean costs, each the mean over the trials `trials[0]` to `trials[1]`, from 1."""

    says: str
    lower: str  # a variant of this figure, or FIGURE-VARIANT of another
    than: str | float  # the same, or a published number
    trials: tuple[int, int]


class Figure(NamedTuple):
    """What a figure's file says."""

    name: str
    title: str
    paper: str
    found: str
    seeds: str
    trials: int
    picture: str
    common: str
    variants: dict[str, str]
    claims: tuple[Claim, ...]


PICTURES = ("curves", "area")
NEEDED = ("title", "trials", "variants")
KINDS: dict[str, type] = {
    "title": str,
    "paper": str,
    "found": str,
    "seeds": str,
    "trials": int,
    "picture": str,
    "common": str,
    "variants": dict,
    "claims": list,
}


def read(path: Path) -> Figure:
    """The figure of a file. Raises ConfigError, in one line, for a file that is not one."""
    try:
        said = tomllib.loads(path.read_text())
    except OSError as error:
        near = (
            did_you_mean(path.stem, [p.stem for p in sorted(path.parent.glob("*.toml"))])
            if path.parent.is_dir()
            else ""
        )
        raise ConfigError(f"{path} cannot be read: {error.strerror}" + (f"; {near}" if near else "")) from error
    except ValueError as error:
        raise ConfigError(f"{path} is not TOML: {error}") from error
    for key, value in said.items():
        if key not in KINDS:
            raise ConfigError(f"{path}: {key} is not a key of a figure; {did_you_mean(key, KINDS)}")
        if not isinstance(value, KINDS[key]) or isinstance(value, bool):
            raise ConfigError(f"{path}: {key}={value} is not {_article(KINDS[key])}")
    for key in NEEDED:
        if not said.get(key):
            raise ConfigError(f"{path}: {key} is missing")
    for label, words in said["variants"].items():
        if not isinstance(words, str):
            raise ConfigError(f'{path}: variant {label} is not a text of settings; for example "search.grad_clip=1"')
        if not re.fullmatch(r"[\w.-]+", label):
            raise ConfigError(f"{path}: variant '{label}' cannot be part of a file's name; letters, digits, . _ -")
    if said.get("picture", "curves") not in PICTURES:
        raise ConfigError(f"{path}: picture={said['picture']} is unknown; {did_you_mean(said['picture'], PICTURES)}")
    claims = tuple(_claim(path, claim) for claim in said.get("claims", ()))
    fields: dict[str, Any] = (
        dict(paper="", found="", seeds="0-9", picture="curves", common="") | said | {"claims": claims}
    )
    return Figure(path.stem, **fields)


def _claim(path: Path, said: Any) -> Claim:
    fields = Claim._fields
    if not isinstance(said, dict) or {*said} != {*fields}:
        raise ConfigError(f"{path}: a claim has {', '.join(fields)}; this one has {', '.join(said) or 'nothing'}")
    span = said["trials"]
    if not (
        isinstance(span, list) and len(span) == 2 and all(isinstance(t, int) for t in span) and 1 <= span[0] <= span[1]
    ):
        raise ConfigError(f"{path}: a claim's trials={span} are not first and last; for example [1, 15]")
    if not (isinstance(said["than"], str | float | int) and isinstance(said["lower"], str)):
        raise ConfigError(f"{path}: a claim's lower is a variant, its than a variant or a number: see '{said['says']}'")
    return Claim(said["says"], said["lower"], said["than"], (span[0], span[1]))


def _article(kind: type) -> str:
    return {str: "a text", int: "a whole number", dict: "a table", list: "a list of tables"}[kind]
