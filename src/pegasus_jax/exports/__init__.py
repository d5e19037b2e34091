"""A learned policy as a file that runs without this package: NumPy, C, ONNX or StableHLO."""
