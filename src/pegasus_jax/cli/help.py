"""What the commands say of themselves."""

import textwrap
from collections.abc import Sequence

from pegasus_jax.checks import ConfigError

TRAIN = """\
pegasus-train task=NAME [setting=value ...]     learn a controller
pegasus-train resume=RUN [trials=N ...]         continue a run, also one that was killed

These are the most common settings, with their defaults. --help=all shows all of them.

{words}

pegasus-check with the same settings tests a task and moves nothing. pegasus-completion makes your shell complete the
settings. Add the output of --version --verbose to a bug report.

examples
  pegasus-train task=cartpole
  pegasus-train task=cartpole policy.hidden=[50,50] seed=3 trials=10 out=runs/demo
  pegasus-train task=gym env=Pendulum-v1 cost=mymodule:cost horizon=40
  pegasus-train task=gym env=robot:Arm-v0 cost=robot:cost start_mean=[3.14,0] eval_episodes=0       (a robot)
  pegasus-train task=mjcf mjcf=arm.xml cost=mymodule:cost dt=0.05 horizon=40
  pegasus-train resume=runs/demo trials=20

To see a run, finished or not: pegasus-report RUN, pegasus-watch RUN, pegasus-plot RUN, pegasus-eval RUN, pegasus-play
RUN. With TensorBoard: pip install tensorboard, then tensorboard --logdir RUN/tensorboard.
"""

TRAIN_ALL = """\
pegasus-train task=NAME [setting=value ...]     learn a controller
pegasus-train resume=RUN [trials=N ...]         continue a run

A task begins with a preset, which has a value for each setting. Then model=, policy= and algorithm= change whole
sections of it, and single settings come last. The values below are those of task=cartpole. For the values of another
command add its settings: pegasus-train task=gym algorithm=paper --help=all

{words}

The environment variable PEGASUS_SETTINGS="fit.steps=5 search.steps=5" adds these settings to every pegasus-train
command, after those that you type. If a setting has two values, the last one counts.

examples
  pegasus-train task=cartpole seeds=10
  pegasus-train task=cartpole algorithm=deep_pilco search.grad_clip=1
  pegasus-train task=swimmer_corkscrew legs=6
  pegasus-train resume=runs/demo trials=20 search.steps=2000
"""

CHECK = """\
pegasus-check task=NAME [setting=value ...]     test a task before you learn it

Takes the settings of pegasus-train, which does the same test first. Opens the environment, resets it once, sends no
control and closes it. Without start_mean= it resets more often, as pegasus-train does. Prints spaces, limits, control
period, the start and the cost there. Notes tell what may be wrong: a cost above 1, angles that look like degrees,
readings that never change or that repeat others. A task that cannot be learned gives one line and exit status 2.

examples
  pegasus-check task=gym env=robot:Arm-v0 cost=robot:cost angles=[0] start_mean=[3.14,0]
  pegasus-check task=mjcf mjcf=arm.xml cost=mymodule:cost dt=0.05 horizon=40
"""

EVALUATE = """\
pegasus-eval RUN [trial=best] [episodes=20] [seed=0] [json=true]     run a learned policy on its plant

Runs fresh episodes, which the run never learns from. trial= chooses the policy: best, last, or the number of a trial.
mjcf=FILE gives the new place of a MuJoCo file that was moved.

Prints the trial of the policy, its mean cost per step, and its success rate: the share of episodes whose last five
steps cost less than the task's success= on average. json=true prints one JSON object with all numbers and a
fingerprint, the SHA-256 of data, model and policy: two runs with the same fingerprint are equal.
"""

PLOT = """\
pegasus-plot RUN|FOLDER     draw a run, or all runs in a folder, finished or not

Writes RUN/plots/learning.png, cost and success against plant time, and a RUN/plots/trial_NNNN.png for every trial:
states, controls and cost of the imagined particles after that trial, and over them the next episode on the plant.

For a folder of runs, such as a sweep's, writes FOLDER/learning.png. Runs that differ only in the seed have one color:
a thin line for each seed, a thick one for their interquartile mean, and its 95 % bootstrap interval. pegasus-report
shows more.
"""

PLAY = """\
pegasus-play RUN [trial=best] [episodes=1] [seed=0]     film a learned policy on its plant

Drives the run's environment, which it opens with render_mode="rgb_array", or simulates its plant. Writes RUN/play.mp4,
in real time at 20 pictures a second, with the cost and the controls drawn below. trial= chooses the policy: best,
last, or the number of a trial. Another seed= gives other starts and other noise.

No display is needed: OpenGL comes from EGL or OSMesa, and MUJOCO_GL=egl|osmesa|glfw chooses. Without a graphics card
a picture takes .1 to .2 s, so the 20 s of a swimmer take a minute.

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
