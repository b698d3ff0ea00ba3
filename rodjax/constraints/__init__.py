"""What holds a rod: its ends, and supports between them."""
