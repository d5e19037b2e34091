"""The six-legged swimmer: its hull and legs, the water, and the four maneuvers."""
