"""Runs as pages that need no network: what is on them, how it is drawn, and how it is served while it grows."""
