"""What a rod is: sections, shapes, state, strains, balance, topology of its line."""
