"""The equations of a scene, in a step and at rest, and their structured matrix."""
