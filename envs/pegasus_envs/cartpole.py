"""Cart-pole swing-up: a cart on a rail carries a freely turning rod, which a force on the cart shall swing upright."""

from functools import partial

import jax.numpy as jnp
import numpy as np
from jax import Array

from pegasus_envs import physics
from pegasus_envs.physics import Motion, Scalar
from pegasus_envs.plant import FRAME, Plant, draw_start, substates_of

XML = "cartpole.xml"


def cartpole(
    *,
    pole_length: Scalar = 0.6,
    pole_mass: Scalar = 0.5,
    cart_mass: Scalar = 0.5,
    friction: Scalar = 0.1,
    gravity: Scalar = 9.82,
) -> Plant:
    """The paper's cart-pole; x = [position, its rate, the angle's rate, angle], angle 0 hanging and pi upright.

    Args:
        pole_length: of the uniform rod [m]
        pole_mass: [kg]
        cart_mass: [kg]
        friction: of the cart on its rail, viscous [N s/m]
        gravity: [m/s^2]

    Any of them may be traced: `jax.vmap(lambda length: simulate(cartpole(pole_length=length), ...))`.
    """
    system = physics.load(XML, _changes(pole_length, pole_mass, cart_mass, friction, gravity))
    dt = 0.1
    low, high = system.host.actuator_ctrlrange.T.copy()

    def state_from_observation(x: Array) -> Motion:
        return Motion(jnp.stack([x[0], x[3]]), jnp.stack([x[1], x[2]]))

    def step(motion: Motion, control: Array, duration: float = dt) -> Motion:
        return physics.hold(system, motion, jnp.clip(control, low, high), duration)

    def observe(motion: Motion) -> Array:
        (position, angle), (speed, rate) = motion
        return jnp.stack([position, speed, rate, angle])

    def error(x: Array) -> Array:
        """From the tip to where it is when the pole stands upright over the middle of the rail [m]."""
        return jnp.stack([x[0] + pole_length * jnp.sin(x[3]), pole_length * (jnp.cos(x[3]) + 1.0)])

    start_mean, start_std = np.zeros(4), np.full(4, 0.2)
    return Plant(
        reset=lambda key: state_from_observation(draw_start(key, start_mean, start_std)),
        step=step,
        substates=substates_of(partial(step, duration=FRAME), dt),
        observe=observe,
        state_from_observation=state_from_observation,
        error=error,
        width=0.25,
        control_low=low,
        control_high=high,
        dt=dt,
        horizon=25,
        start_mean=start_mean,
        start_std=start_std,
        sensor_std=np.full(4, 0.01),
        angles=(3,),
        state_names=("x [m]", "x' [m/s]", "theta' [rad/s]", "theta [rad]"),
        control_names=("force [N]",),
        model=system.host,
        qpos=lambda motion: motion.qpos,
        rates=(1, 2),
    )


def _changes(length: Scalar, mass: Scalar, cart: Scalar, friction: Scalar, gravity: Scalar) -> list[physics.Change]:
    """What the constants determine in the model; geoms are for the eye only."""
    model = physics.default(XML)
    return [
        *physics.uniform_rod(model, "pole", length, mass, up=-1.0),
        ("geom_pos", (model.geom("tip").id, 2), -1.0 * length),
        ("geom_pos", (model.geom("goal").id, 2), length),
        ("body_mass", model.body("cart").id, cart),
        ("dof_damping", 0, friction),
        ("opt.gravity", 2, -1.0 * gravity),
    ]
