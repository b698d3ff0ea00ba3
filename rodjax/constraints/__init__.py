"""What holds a rod: its ends."""
