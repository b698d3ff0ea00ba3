"""What acts on a rod: loads, and contact by a law between points found near."""
