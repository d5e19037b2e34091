"""Plant time and wall time until a plant is solved, of other programs beside ours. See `__main__`."""
