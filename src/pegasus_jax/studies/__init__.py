"""Experiments over many seeds: what the paper's figures and our tables are made of."""
