"""Export of motion to files that other programs read."""
