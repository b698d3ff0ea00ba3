"""Runs and sweeps in files and in pictures, with their units."""
