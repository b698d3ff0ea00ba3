"""What acts on a rod: loads, and contact of strands by a law between points found near."""
