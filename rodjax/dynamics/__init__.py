"""Rods in motion: starts, steps, rollouts, runs, and what these do not resolve."""
