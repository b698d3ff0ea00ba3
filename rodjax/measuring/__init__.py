"""What states and runs are measured by: energies, reactions, linking, checks."""
