"""The paper's plants, simulated by MJX: cart-pole, double cart-pole, six-legged swimmer.

Importing this registers them with Gymnasium and does nothing else: no model is built, no device touched.
"""

from pegasus_envs.registry import IDS, register

__all__ = ["IDS", "register"]

register()
