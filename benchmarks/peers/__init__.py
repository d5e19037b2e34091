"""Other programs for the same work, timed beside ours in one run. See `compare`."""
