"""Runs and sweeps in files."""
