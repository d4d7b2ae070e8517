"""The report of a run: images, plots and tables that people judge it by."""
