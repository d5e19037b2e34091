"""Mathematics that knows nothing of control: angles, scaling, Gaussians."""
