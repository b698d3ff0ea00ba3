"""The same scenes solved in two other ways, to check the first by."""
