"""The bad commands: settings with values of the wrong kind, wrong words and options, faulty costs and robots."""

from __future__ import annotations

import random
import re
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

from tests.campaigns.common import SMALL


def words_of(text: str) -> list[str]:
    """The words of a line."""
    return text.split()


HERE = Path(__file__).parent
HUGE = "1" + "0" * 20
VALUES = [
    *words_of(
        "-1 0 1.5 1e20 -1e-300 .nan .inf -.inf true null word [] [1] [[1]] [1,[2]] {a:1} ${seed} ${oc.env:HOME} 1,2"
    ),
    *words_of("0x1F !!python/object/apply:os.getcwd 1e400 [.nan] [-1] ['a'] ../.. /dev/null = # : 1..3 1_0 ∞ ünï 二"),
    *("", " ", HUGE, "-" + HUGE, "x" * 5000, "[" * 200, "[" + "1," * 3000 + "1]", "a\nb", "'"),
]
BASE = (*SMALL, "trials=1", "eval_episodes=0", "out=new")
GYM = (*BASE[1:], "task=gym", "horizon=8", "angles=[0]", "start_mean=[3.14,0]")


class Command(NamedTuple):
    """A command, and whether it must be refused; else it may also work."""

    name: str
    words: tuple[str, ...]
    refused: bool = False
    limit: float = 90.0


def train(*words: str, begin: Sequence[str] = BASE, refused: bool = False) -> Command:
    """pegasus-train with these words and those of `begin` that they do not say otherwise."""
    said = {word.partition("=")[0] for word in words}
    return Command("pegasus-train", (*(word for word in begin if word.partition("=")[0] not in said), *words), refused)


def settings_words() -> list[Command]:
    """Every setting of the default config with every value."""
    from pegasus_jax.config import Config
    from pegasus_jax.runs.config_io import leaves

    return [train(f"{name}={value}") for name in leaves(Config()) for value in VALUES]


def misspelt() -> list[Command]:
    """Words that are no settings."""
    words = words_of(
        "serach.steps=5 searchsteps=5 search=5 fit.=5 .steps=5 fit.steps.x=5 Trials=3 trials:3 --trials=3 --trials"
        " -v =3 = task model= policy= algorithm=fastest task=cartpol model=gpp policy=mpl mesh=2 mesh=0x1 mesh=1x"
        " seeds=0 seeds=-1 seeds=two resume= resume=nothing resume=. distributed=maybe coordinator=here process=1"
        " out=/proc/x out=/dev/null seeds="
        + HUGE
        + " mesh="
        + HUGE
        + "x1 legs=4 legs=6 env=Pendulum-v1 mjcf=arm.xml horizon=40"
        " dt=.1 angles=[0] rates=[1] observe=[qpos.0] control_low=[-1] start_mean=[0] cost=robots:cost x64=half"
    )
    return [train(word, refused=True) for word in words]


def combinations() -> list[Command]:
    """Settings that do not go together, or do not fit the task."""
    gym = (*GYM, "env=robots:Arm-v0", "cost=robots:cost")
    of_gym = words_of(
        "angles=[0,0] angles=[2] angles=[-1] angles=[0.5] rates=[0,0] rates=[1,0,1] start_mean=[3.14]"
        " start_mean=[.nan,0] start_mean=[0,0,0] start_std=[1,2,3] start_std=[-1] control_low=[5] control_high=[-5]"
        " control_low=[.nan] control_low=[-1,-1] dt=0 dt=-1 dt=.nan horizon=0 horizon=-3 horizon="
        + HUGE
        + " seeds=2 env=none:None-v0"
        " env=robots:None-v0 env=robots env= cost=robots cost=robots:none cost=none:cost cost=:cost cost=robots: cost="
        " cost=os:system cost=math:sin cost=builtins:exit explore.trials=-1 observe=[qpos.0] mjcf=arm.xml legs=6"
    )
    mjcf = (*BASE[1:], "task=mjcf", "cost=robots:cost")
    of_mjcf = ("mjcf=none.xml", "mjcf=.", "mjcf=robots.py", "mjcf=/dev/null", "mjcf=empty.xml")
    texts = [
        "search.risk=.5",
        "search.num_starts=2 search.reset_optimizer=false",
        "model.log_z_min=1",
        "policy.dropout=2",
    ]
    lone = [("task=gym",), ("task=mjcf",), ("task=gym", "env=Pendulum-v1"), ("task=gym", "cost=robots:cost")]
    return [
        *(train(word, begin=gym, refused=True) for word in of_gym),
        *(train(word, begin=mjcf, refused=True) for word in of_mjcf),
        *(train(*text.split(), refused=True) for text in texts),
        *(Command("pegasus-train", words, refused=True) for words in lone),
    ]


def faulty() -> list[Command]:
    """Costs and robots of faults.py, a module that cannot be imported, one that leaves."""
    source = (HERE / "faults.py").read_text()
    names = [*re.findall(r"^def (\w+)", source, re.MULTILINE), "number", "absent", "sys.exit"]
    robots = re.findall(r"^class (\w+)", source, re.MULTILINE)
    pairs = [("faults:Arm", f"faults:{name}") for name in names]
    pairs += [(f"faults:{name}", "robots:cost") for name in robots]
    pairs += [(f"{module}:Arm", "robots:cost") for module in ("broken", "leaving", "raising")]
    pairs += [("robots:Arm", f"{module}:cost") for module in ("broken", "leaving", "raising")]
    pairs += [(f"robots:{name}", "robots:cost") for name in ("Asks", "NaN", "Ends", "Truncates", "CloseRaises")]
    fine = {
        "robots:Ends",
        "robots:Truncates",
        "robots:CloseRaises",
        "faults:asserts",
        "faults:NoFrames",
        "faults:PeriodIsMethod",
        "faults:Whole",
        "faults:Columns",
        "faults:no_gradient",
    }
    return [train(f"env={env}-v0", f"cost={cost}", begin=GYM, refused=not fine & {env, cost}) for env, cost in pairs]


FOLDERS = (".", "/")  # pegasus-plot takes folders of runs


def of_runs() -> list[Command]:
    """The commands that read a run, with options that they have not; `run` is one that is there."""
    words = words_of(
        "run:episodes=0 run:episodes=-1 run:episodes=two run:episodes=1.5 run:episodes= run:seed=-1 run:seed=x"
        " run:seed="
        + HUGE
        + " run:episode=3 run:trials=3 run:--json run:run none . / robots.py =run run:out=x run/episodes"
        " run:json=maybe run:trial=99 run:trial=-1 run:trial=best? run:trial=" + HUGE
    )
    readers = ("pegasus-eval", "pegasus-plot", "pegasus-play")
    sweeps = words_of(
        "task=none seed=0- seed=3-1 jobs=0:task=cartpole launcher=cloud launcher=slurm:slurm.x= trials=1,1 fit.steps="
        " out= seed=0-99999999999 trials=[1 model=bnn,gpp slurm.time=1 resume=run"
    )
    return [
        *(
            Command(name, tuple(word.split(":")), refused=name != "pegasus-plot" or word not in FOLDERS)
            for name in readers
            for word in words
        ),
        *(Command("pegasus-sweep", ("launcher=print", *word.split(":")), refused=True) for word in sweeps),
        *(Command("pegasus-check", (*SMALL, word), refused=True) for word in ("trials=0", "serach.steps=1")),
    ]


def chosen(cases: int, seed: int) -> list[Command]:
    """So many of them: half are settings' values, the rest is shared among the other kinds."""
    draw = random.Random(seed)
    rest = [*misspelt(), *combinations(), *faulty(), *of_runs()]
    others = draw.sample(rest, min(len(rest), cases // 2))
    return [*others, *draw.sample(settings_words(), cases - len(others))]
