"""The paper's plants, simulated by MJX: cart-pole, double cart-pole, six-legged swimmer."""
