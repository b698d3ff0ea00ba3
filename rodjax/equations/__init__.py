"""The equations of a scene, at rest and in a step, and their structured matrix."""
