"""PILCO's pieces: Gaussian processes, RBF controllers, analytic moments. Not needed to understand the method."""
