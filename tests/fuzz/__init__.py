"""Seeded mutations of good matches, stores and requests: `python -m tests.fuzz --help`."""
