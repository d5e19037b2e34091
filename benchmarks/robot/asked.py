"""What a user writes for each task of benchmarks/robot/costs.py: a cost by its terms, a reference, goals."""

import jax.numpy as jnp

from pegasus_jax.types import Array

POLE, WIDTH = 0.6, 0.25  # of the project's cart-pole [m]: the pole's length, and the width of its cost
LARGEST = 10.0  # its force [N]
EFFORT, RATE = 0.01, 0.3  # weights of the square of a control, and of its change, as fractions of the largest


def near(square: Array, width: float) -> Array:
    """1 - exp(-e^2 / 2 width^2) of an error e, by its square."""
    return -jnp.expm1(-0.5 * square / width**2)


def close(square: Array, far: float, exact: float) -> Array:
    """The mean of two such costs: one leads there from afar, one holds the error small."""
    return (near(square, far) + near(square, exact)) / 2


def swing_up(x: Array) -> Array:
    """[x, x', angle', angle], 0 hanging: the tip over the middle of the rail, half of it the project's own cost.

    The other half falls from where the pole hangs: beside a cost that is flat there, doing nothing would be the best.
    """
    tip = (x[0] + POLE * jnp.sin(x[3])) ** 2 + (POLE * (jnp.cos(x[3]) + 1)) ** 2
    return close(tip, 0.8, WIDTH)


def swing_up_smoothly(x: Array, u: Array, previous_u: Array) -> Array:
    """The same, and what the force and its changes cost."""
    change = (u[0] - previous_u[0]) / LARGEST
    return swing_up(x) + EFFORT * (u[0] / LARGEST) ** 2 + RATE * change**2


def swing_up_more_smoothly(x: Array, u: Array, previous_u: Array) -> Array:
    """The same with three times the weight on changes."""
    change = (u[0] - previous_u[0]) / LARGEST
    return swing_up(x) + EFFORT * (u[0] / LARGEST) ** 2 + 3 * RATE * change**2


def sine(t: Array) -> Array:
    """Where the cart is to be [m]: 0.3 m to each side, in 2.5 s."""
    return 0.3 * jnp.sin(2 * jnp.pi * t / 2.5)


def follow(x: Array, reference: Array) -> Array:
    """The cart where the reference is, whatever the pole does that hangs from it."""
    return close((x[0] - reference[0]) ** 2, 0.3, 0.05)


def follow_upright(x: Array, reference: Array) -> Array:
    """The same with the pole upright: its tip above the reference."""
    tip = (x[0] + POLE * jnp.sin(x[3]) - reference[0]) ** 2 + (POLE * (jnp.cos(x[3]) + 1)) ** 2
    return close(tip, WIDTH, 0.1)


def hand(x: Array) -> Array:
    """Place [m] of the hand of examples/own_mjcf.xml; x is (shoulder, elbow, their rates), both links 0.5 m."""
    shoulder, elbow = x[0], x[0] + x[1]
    return 0.5 * jnp.stack([jnp.cos(shoulder) + jnp.cos(elbow), jnp.sin(shoulder) + jnp.sin(elbow)])


def path(t: Array) -> Array:
    """Where the hand is to be [m]: on a line of 0.6 m, as a sine in 3 s."""
    return jnp.stack([jnp.asarray(0.6), 0.3 * jnp.sin(2 * jnp.pi * t / 3)])


def draw_path(x: Array, reference: Array) -> Array:
    """The hand where the reference is."""
    return close(jnp.sum((hand(x) - reference) ** 2), 0.4, 0.05)


def fingertip(x: Array) -> Array:
    """Place [m] of the fingertip of Gymnasium's reacher.xml; x is (two joints, their rates)."""
    first, second = x[0], x[0] + x[1]
    return jnp.stack([0.1 * jnp.cos(first) + 0.11 * jnp.cos(second), 0.1 * jnp.sin(first) + 0.11 * jnp.sin(second)])


def reach(x: Array, goal: Array) -> Array:
    """The fingertip at the goal: less than 0.2 within 3 cm."""
    return close(jnp.sum((fingertip(x) - goal) ** 2), 0.15, 0.03)
