"""Measurements: speed (suite), learning (study; figures/ are files for pegasus-figures), pictures for the documentation."""
