"""The plants as data: what a user knows of each. No setting of a model or a search is here."""

from typing import NamedTuple


def task(
    horizon: int, cost: str, stop: str = "", angles: str = "[]", module: str = "costs", rates: str = ""
) -> tuple[str, ...]:
    """The words of pegasus-train that describe a task, with functions of costs.py or another module here."""
    named = {"cost": cost, "stop": stop}
    functions = (f"{setting}=benchmarks.plants_suite.{module}:{name}" for setting, name in named.items() if name)
    known = [f"rates={rates}"] if rates else []  # for model=lagrangian
    return (f"horizon={horizon}", f"angles={angles}", *known, *functions)


class Plant(NamedTuple):
    """A Gymnasium environment, and what its own return has to be."""

    env: str
    words: tuple[str, ...]
    trials: int
    bar: float  # of the native return, mean of 10 to 50 episodes
    by: float  # plant time at which the bar is to be reached [s]


HAND = "benchmarks.plants_suite.by_hand:"
AIO = "benchmarks.plants_suite.of_ai_olympics:ai_olympics/"
DM = "benchmarks.plants_suite.of_dm_control:dm_control/"
IP, IDP = "InvertedPendulum-v5", "InvertedDoublePendulum-v5"
PLANTS: dict[str, Plant] = {
    "Pendulum-v1": Plant("Pendulum-v1", task(40, "pendulum", rates="[2]"), 12, -200.0, 16.0),
    IP: Plant(
        IP, task(50, "inverted_pendulum", "inverted_pendulum_falls", angles="[1]", rates="[2,3]"), 20, 950.0, 30.0
    ),
    # The last entry is a force, and no part of the state.
    IDP: Plant(
        IDP,
        (*task(40, "double_pendulum", "double_pendulum_falls", rates="[5,6,7]"), "sensors.measured=[0,1,2,3,4,5,6,7]"),
        30,
        8500.0,
        60.0,
    ),
    # The last two entries follow from the others.
    "Reacher-v5": Plant(
        "Reacher-v5", (*task(50, "reacher"), "success=0.01", "sensors.measured=[0,1,2,3,4,5,6,7]"), 60, -6.0, 60.0
    ),
    "dm_cartpole": Plant(f"{DM}CartPole-v0", task(25, "dm_cartpole", angles="[1]", rates="[2,3]"), 12, 850.0, 25.0),
    "dm_pendulum": Plant(
        f"{DM}Pendulum-v0", task(80, "pendulum", angles="[0]", module="costs_of_joints", rates="[1]"), 8, 800.0, 40.0
    ),
    # Its return is minus the sum of the cost: a swing-up that holds has some -11, a slow one that never holds -16.
    "CartPole": Plant(
        "pegasus_envs:pegasus/CartPoleSwingUp-v0", task(25, "cartpole", angles="[3]", rates="[1,2]"), 15, -12.5, 20.0
    ),
    # A weak motor in a valley, whose episodes end on the hill; its rate is .01 m a step.
    "MountainCarContinuous-v0": Plant(
        "MountainCarContinuous-v0", (*task(150, "mountain_car", "mountain_car_is_up"), "stop_cost=0"), 6, 90.0, 15.0
    ),
    # The most is 250, for who has been above the line for all of the 10 s.
    "pendubot": Plant(f"{AIO}Pendubot-v0", task(50, "two_links", angles="[0,1]", rates="[2,3]"), 30, 125.0, 60.0),
    "acrobot": Plant(f"{AIO}Acrobot-v0", task(50, "two_links", angles="[0,1]", rates="[2,3]"), 45, 125.0, 90.0),
    # Held back. The most is 200, one for each period.
    "Quadrotor": Plant(
        f"{HAND}Quadrotor-v0", task(40, "quadrotor", angles="[2]", module="by_hand", rates="[3,4,5]"), 6, 180.0, 12.0
    ),
    "BallOnBeam": Plant(
        f"{HAND}BallOnBeam-v0", task(50, "ball_on_beam", module="by_hand", rates="[2,3]"), 14, 180.0, 20.0
    ),
    "FourTanks": Plant(f"{HAND}FourTanks-v0", task(40, "four_tanks", module="by_hand"), 5, 180.0, 1000.0),
    "Car": Plant(f"{HAND}Car-v0", task(30, "car", angles="[2]", module="by_hand"), 12, 180.0, 72.0),
}
