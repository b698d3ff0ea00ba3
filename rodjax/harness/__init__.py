"""Rodjax as a solver in benchmarks that others keep."""
