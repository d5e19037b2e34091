"""What the commands say of themselves."""

import textwrap
from collections.abc import Sequence

from pegasus_jax.checks import ConfigError

TRAIN = """\
pegasus-train task=NAME [setting=value ...]     learn a controller
pegasus-train resume=RUN [trials=N ...]         go on with a run, also one that was killed

{words}

--help=all shows every word, --version --verbose what a report of a problem needs. pegasus-check, with the same words,
looks at a task and moves nothing. pegasus-completion makes a shell complete the words.

examples
  pegasus-train task=cartpole
  pegasus-train task=cartpole policy.hidden=[50,50] seed=3 trials=10 out=runs/demo
  pegasus-train task=gym env=Pendulum-v1 cost=mymodule:cost horizon=40
  pegasus-train task=gym env=robot:Arm-v0 cost=robot:cost start_mean=[3.14,0] eval_episodes=0       (a robot)
  pegasus-train task=mjcf mjcf=arm.xml cost=mymodule:cost dt=0.05 horizon=40
  pegasus-train resume=runs/demo trials=20

Look at a run, finished or not, with pegasus-report RUN, pegasus-watch RUN, pegasus-plot RUN, pegasus-eval RUN or
pegasus-play RUN; or with tensorboard --logdir RUN/tensorboard, after pip install tensorboard.
"""

TRAIN_ALL = """\
pegasus-train task=NAME [setting=value ...]     learn a controller
pegasus-train resume=RUN [trials=N ...]         go on with a run

A preset is a value for each setting; model=, policy= and algorithm= change whole sections of it, and single settings
come last. Shown is what they are with the words beside --help=all: pegasus-train task=gym algorithm=paper --help=all

{words}

PEGASUS_SETTINGS="fit.steps=5 search.steps=5" in the environment adds these words to every pegasus-train command,
after those that are typed: of two values of a setting, the last one counts.

examples
  pegasus-train task=cartpole seeds=10
  pegasus-train task=cartpole algorithm=deep_pilco search.grad_clip=1
  pegasus-train task=swimmer_corkscrew legs=6
  pegasus-train resume=runs/demo trials=20 search.steps=2000
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
pegasus-eval RUN [trial=best] [episodes=20] [seed=0] [json=true]     run a learned policy on its plant

Uses the policy after trial=N, trial=last or the best trial, and episodes that never become data. mjcf=FILE names the
model's file where it was moved.
Prints whose policy it is, mean cost per step and success rate (last five steps cost less than .2 on average). With
json=true, one JSON object: in full, and with a fingerprint, the SHA-256 of data, model and policy, by which two runs
can be told to be the same.
"""

PLOT = """\
pegasus-plot RUN|FOLDER     draw a run, or those in a folder, finished or not

Writes RUN/plots/learning.png (cost and success against plant time) and RUN/plots/trial_NNNN.png for every trial:
states, force and cost of the imagined particles after that trial, and over them what the plant did next.
For a folder of runs, such as a sweep's, FOLDER/learning.png: those that differ in the seed alone have one color, every
seed's raw curve thin, their interquartile mean thick with its 95 % bootstrap interval. pegasus-report shows more.
"""

PLAY = """\
pegasus-play RUN [trial=best] [episodes=1] [seed=0]     film a learned policy on its plant

Drives the run's environment, which is opened with render_mode="rgb_array", or simulates its plant.
Writes RUN/play.mp4: fresh episodes of the best policy, or that after trial=N or trial=last, in real time,
20 pictures a second, with cost and command drawn below as they come about. Another seed= gives other starts and
other noise. No display is needed: OpenGL comes from EGL or OSMesa, and MUJOCO_GL=egl|osmesa|glfw chooses; without
a graphics card a picture takes a tenth of a second or two, so a minute for the swimmer's 20 s.

examples
  pegasus-play runs/cartpole-seed0
  pegasus-play runs/cartpole-seed0 episodes=5 seed=1
"""

ALL = "--help=all"
WORDS = {"-h", "--help", "help", ALL}


def asked(words: Sequence[str]) -> bool:
    """Whether help is asked for. Raises ConfigError for help that there is not."""
    for word in words:
        if word.startswith("--help=") and word != ALL:
            raise ConfigError(f"{word} is unknown; did you mean '{ALL}'? choices: --help, {ALL}")
    return bool(WORDS & {*words})


def help_of(text: str, words: Sequence[str]) -> str:
    """A command's help; of its settings as these words leave them. Raises ConfigError for words that cannot be."""
    if "{words}" not in text:
        return text
    from pegasus_jax.cli.words import FIRST, OPTIONS, described, grouped
    from pegasus_jax.config import KINDS
    from pegasus_jax.runs import config_io

    _, dotted = config_io.split([word for word in words if word not in WORDS], tuple(OPTIONS))
    config = config_io.parse(dotted, tuple(OPTIONS))
    known = described(config)
    if ALL not in words:
        return text.format(words="\n".join(line(*known[word]) for word in FIRST))
    parts = {title: [known[word] for word in of] for title, of in grouped(known).items()}
    for section, kinds in KINDS.items():
        for kind, default in kinds.items():
            if kind != getattr(config, section).kind:
                title = f"with {section}.kind={kind}, chosen by model=, policy= or algorithm="
                parts[title] = list(config_io.described(default, f"{section}.").values())
    whole = ["\n".join([title, *(line(*one) for one in lines)]) for title, lines in parts.items() if lines]
    return TRAIN_ALL.format(words="\n\n".join(whole))


def line(word: str, text: str) -> str:
    """What help says of a word, in lines of at most 120 characters."""
    return textwrap.fill(text, 120, initial_indent=f"  {word:34s} ", subsequent_indent=" " * 37, break_on_hyphens=False)
