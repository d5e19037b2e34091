"""Measurements: speed (suite), learning (study, figures), pictures for the documentation."""
