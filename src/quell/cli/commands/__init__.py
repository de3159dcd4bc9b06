"""The commands: one file for each, with its options, its help and its work."""
