"""A rod with what acts on it and holds it, and what is checked of the whole."""
