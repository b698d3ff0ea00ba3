"""Runs to look at: turned about in three dimensions, as films and as figures."""
