"""Rods in motion: starts, steps, rollouts, runs, and whether they resolve what happens."""
