"""Runs and sweeps in files, with their units."""
