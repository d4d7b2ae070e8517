"""A released data set: its manifest, its statistics, and the check of its content."""
