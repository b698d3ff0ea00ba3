"""What a rod is: sections, shapes, state, strains, balance, and the topology of its line."""
