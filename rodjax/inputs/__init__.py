"""What people give: numbers with names of units, functions and schedules, checked once."""
