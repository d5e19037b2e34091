"""Learning: the data, the fit of a model, and the search for a policy."""
