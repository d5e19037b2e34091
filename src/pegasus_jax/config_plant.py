"""The settings of what happens on a plant: sensors, and the first episodes. config.py has those of everything else."""

from collections.abc import Callable
from dataclasses import dataclass

from pegasus_jax import checks
from pegasus_jax.checks import ConfigError
from pegasus_jax.config_models import setting

EXPLORATIONS = ("uniform", "walk")
EVERY = ("*",)  # the tasks that a setting is of
VELOCITIES = ("none", "difference", "filter")


@dataclass(frozen=True)
class Explore:
    """The first episodes, before there is a model."""

    trials: int = setting(1, "first episodes, with random controls")
    kind: str = setting(
        "uniform", "random controls: uniform, a new one in each period; walk, a random walk, which changes slowly"
    )
    amplitude: float | None = setting(
        None, "part of the control range that random controls grow to over an episode; null: all of it at once", EVERY
    )
    policy: str | Callable | None = setting(  # noqa: RUF009 (frozen)
        None,
        "controller of the first episodes: module:function, observation -> controls, or a run's folder;"
        " explore.amplitude= adds random controls",
        EVERY,
    )

    def __post_init__(self) -> None:
        checks.typed("explore", self)
        checks.size("explore.trials", self.trials, 0)
        checks.choice("explore.kind", self.kind, EXPLORATIONS)
        if self.amplitude is not None:
            checks.check_range("explore.amplitude", self.amplitude, 0, 1, open_low=True)


@dataclass(frozen=True)
class Sensors:
    """What a robot measures, and when; as `Config.sensors`."""

    measured: tuple[int, ...] = setting((), "the entries of the observation that the sensors measure; []: all")
    delay: int = setting(0, "delay in control periods: of the sensors and of the controls together")
    velocity: str = setting(
        "none", "how rates of the measured entries are computed: difference; filter, a low-pass of it; none, not at all"
    )
    cutoff: float | None = setting(None, "cutoff of sensors.velocity=filter [Hz]; null: a fifth of the control rate")

    def __post_init__(self) -> None:
        checks.typed("sensors", self)
        checks.different("sensors.measured", self.measured)
        checks.size("sensors.delay", self.delay, 0)
        checks.choice("sensors.velocity", self.velocity, VELOCITIES)
        if self.cutoff is not None:
            checks.check_range("sensors.cutoff", self.cutoff, 0, open_low=True)
            if self.velocity != "filter":
                raise ConfigError(
                    f"sensors.cutoff={self.cutoff:g} is of no use with sensors.velocity={self.velocity}; the nearest is"
                    " sensors.velocity=filter"
                )
