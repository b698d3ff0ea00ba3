"""What knows nothing of rods: rotations, elimination, Newton, result codes, compilation."""
