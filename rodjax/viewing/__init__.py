"""Runs in three dimensions, to look at in a notebook and to share as one file."""
