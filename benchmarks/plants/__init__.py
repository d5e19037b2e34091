"""The plants themselves: their cost, their distance from C MuJoCo, and whether they can be controlled."""
