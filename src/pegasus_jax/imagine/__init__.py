"""Imagined episodes: pre-drawn scenarios, the rollout, moment matching, and what a rollout costs."""
