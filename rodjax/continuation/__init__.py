"""Paths of equilibria along a parameter, their folds and branch points, critical loads."""
