"""Measurements: speed (suite), learning (study; figures/ is for pegasus-figures), pictures for the documentation."""
