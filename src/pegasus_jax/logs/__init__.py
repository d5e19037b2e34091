"""Data that its user already has: files of earlier episodes, as episodes of a task."""
