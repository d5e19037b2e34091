"""The command pegasus-delay: how many periods pass from a control to what is observed of it."""

import sys
from collections.abc import Sequence

from pegasus_jax.checks import ConfigError, whole
from pegasus_jax.cli.main import main
from pegasus_jax.cli.words import MORE

DELAY = """\
pegasus-delay env=ID [amplitude=0.2] [periods=200] [setting=value ...]     measure the delay of a robot. It moves!

Drives the environment with small random controls, and tells after how many control periods the observation changes.
This is the delay of the motor's driver, the wires, the sensors and their filters together. Before anything moves it
prints which controls it will send. It writes no file. It also takes settings of pegasus-train, such as env_args.*,
angles=, dt=, control_low= and control_high=; it needs no cost.

  amplitude=0.2         size of the controls, as a fraction of half their range. Each period has one above or one below
                        rest, which is 0 or the limit next to it. The range clips them: of [-1, 3] V amplitude=1 sends
                        -1 or 2 V. control_rate= makes them smaller. If they are too small, it finds no change
  periods=200           control periods to drive, in several episodes if horizon= is less; each episode ends with a
                        period at rest. If episodes end early, more follow, up to three times as many periods
  most=8                the largest delay that it looks for

A simulation usually has a delay of 0 periods: a control changes the reading at the end of its own period. For a delay
of D periods, train with sensors.delay=D.

examples
  pegasus-delay env=robot:Arm-v0 angles=[0]
  pegasus-delay env=robot:Arm-v0 angles=[0] amplitude=0.1 periods=800 control_low=[-1] control_high=[1]
"""


def delay() -> None:
    """Entry point of pegasus-delay."""
    main(handle, DELAY, stopped="the environment is closed")


def handle(words: Sequence[str]) -> None:
    """Measure, and say what was found. Raises ConfigError for words that cannot be."""
    from pegasus_jax.runs import config_io

    options, rest = config_io.split(words, MORE["pegasus-delay"])
    amplitude = _number("amplitude", options.get("amplitude", "0.2"))
    periods, most = (whole(name, options.get(name, default)) for name, default in (("periods", "200"), ("most", "8")))
    config = config_io.parse({"task": "gym", **rest}, options=MORE["pegasus-delay"])
    from pegasus_jax.runs.delay import announced, measure, planned, told

    plan = planned(config, amplitude, periods, most)
    print(announced(plan), file=sys.stderr, flush=True)
    print(told(measure(plan)))


def _number(name: str, text: str) -> float:
    """The number of an option. Raises ConfigError for what is none."""
    try:
        return float(text)
    except ValueError as error:
        raise ConfigError(f"{name}={text} is not a number; for example {name}=0.2") from error


if __name__ == "__main__":
    delay()
