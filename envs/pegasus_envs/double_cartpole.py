"""Double cart-pole swing-up: two rods in series on a cart, both to be swung upright by a force on the cart."""

from functools import partial

import jax.numpy as jnp
import numpy as np
from jax import Array

from pegasus_envs import physics
from pegasus_envs.physics import Motion, Scalar
from pegasus_envs.plant import FRAME, Plant, draw_start, substates_of

XML = "double_cartpole.xml"


def double_cartpole(
    *,
    inner_length: Scalar = 0.6,
    outer_length: Scalar = 0.6,
    inner_mass: Scalar = 0.5,
    outer_mass: Scalar = 0.5,
    cart_mass: Scalar = 0.5,
    friction: Scalar = 0.1,
    gravity: Scalar = 9.82,
) -> Plant:
    """The paper's double cart-pole; x = [position, its rate, both angles' rates, both angles].

    Angles are absolute and zero upright; the start hangs, at pi.

    Args:
        inner_length: of the uniform rod on the cart [m]
        outer_length: of the uniform rod at its end [m]
        inner_mass: [kg]
        outer_mass: [kg]
        cart_mass: [kg]
        friction: of the cart on its rail, viscous [N s/m]
        gravity: [m/s^2]

    Any of them may be traced.
    """
    lengths, masses = (inner_length, outer_length), (inner_mass, outer_mass)
    system = physics.load(XML, _changes(lengths, masses, cart_mass, friction, gravity))
    dt = 0.1
    low, high = system.host.actuator_ctrlrange.T.copy()

    def state_from_observation(x: Array) -> Motion:
        position, speed, rate_one, rate_two, one, two = x
        return Motion(jnp.stack([position, one, two - one]), jnp.stack([speed, rate_one, rate_two - rate_one]))

    def step(motion: Motion, control: Array, duration: float = dt) -> Motion:
        return physics.hold(system, motion, jnp.clip(control, low, high), duration)

    def observe(motion: Motion) -> Array:
        (position, one, bend), (speed, rate, bend_rate) = motion
        return jnp.stack([position, speed, rate, rate + bend_rate, one, one + bend])

    def error(x: Array) -> Array:
        """From the tip to where it is when both rods stand upright over the middle of the rail [m]."""
        across = x[0] - inner_length * jnp.sin(x[4]) - outer_length * jnp.sin(x[5])
        up = inner_length * (jnp.cos(x[4]) - 1.0) + outer_length * (jnp.cos(x[5]) - 1.0)
        return jnp.stack([across, up])

    start_mean, start_std = np.array([0.0, 0.0, 0.0, 0.0, np.pi, np.pi]), np.full(6, 0.1)
    return Plant(
        reset=lambda key: state_from_observation(draw_start(key, start_mean, start_std)),
        step=step,
        substates=substates_of(partial(step, duration=FRAME), dt),
        observe=observe,
        state_from_observation=state_from_observation,
        error=error,
        width=0.5,
        control_low=low,
        control_high=high,
        dt=dt,
        horizon=30,
        start_mean=start_mean,
        start_std=start_std,
        sensor_std=np.full(6, 0.01),
        angles=(4, 5),
        state_names=(
            "x [m]",
            "x' [m/s]",
            "theta1' [rad/s]",
            "theta2' [rad/s]",
            "theta1 [rad]",
            "theta2 [rad]",
        ),
        control_names=("force [N]",),
        model=system.host,
        qpos=lambda motion: motion.qpos,
        rates=(1, 2, 3),
    )


def _changes(
    lengths: tuple[Scalar, Scalar], masses: tuple[Scalar, Scalar], cart: Scalar, friction: Scalar, gravity: Scalar
) -> list[physics.Change]:
    """What the constants determine in the model; geoms are for the eye only."""
    model = physics.default(XML)
    return [
        *physics.uniform_rod(model, "inner", lengths[0], masses[0], up=1.0),
        *physics.uniform_rod(model, "outer", lengths[1], masses[1], up=1.0),
        ("body_pos", (model.body("outer").id, 2), lengths[0]),
        ("geom_pos", (model.geom("tip").id, 2), lengths[1]),
        ("geom_pos", (model.geom("goal").id, 2), lengths[0] + lengths[1]),
        ("body_mass", model.body("cart").id, cart),
        ("dof_damping", 0, friction),
        ("opt.gravity", 2, -1.0 * gravity),
    ]
