"""Controllers: each module makes values of `types.Policy`."""
