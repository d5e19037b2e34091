"""Models of the dynamics: each module makes values of `types.Dynamics`."""
