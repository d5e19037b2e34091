"""Measurements of what a robot needs, each with one command."""
