"""What people give: numbers, functions and schedules, checked once."""
