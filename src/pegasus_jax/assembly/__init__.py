"""Settings -> pieces: the only folder that matches on the kind of a setting."""
