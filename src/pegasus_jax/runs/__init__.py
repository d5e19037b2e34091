"""Runs on disk: the main job, its folder, checkpoints, and everything that survives a crash."""
