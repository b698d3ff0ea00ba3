"""Parameters of scenes from what was observed."""
