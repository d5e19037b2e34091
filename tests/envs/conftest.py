"""Plants and their compiled simulations, shared by all tests here: compiling takes longer than simulating."""

from functools import cache

import pytest

from envs.references import Simulated, simulated
from pegasus_envs.cartpole import cartpole
from pegasus_envs.double_cartpole import double_cartpole
from pegasus_envs.swimmer.plant import swimmer


@cache
def _swimmer(legs: int) -> Simulated:
    return simulated(swimmer("knife_edge", legs))


@pytest.fixture(scope="session")
def cart() -> Simulated:
    return simulated(cartpole())


@pytest.fixture(scope="session")
def double() -> Simulated:
    return simulated(double_cartpole())


@pytest.fixture(scope="session", params=[2, 6], ids=["two legs", "six legs"])
def swim(request) -> Simulated:
    return _swimmer(request.param)
