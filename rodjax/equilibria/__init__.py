"""Rods at rest: load paths, unstable modes, stability, vibration."""
