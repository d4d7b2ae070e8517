"""Uses of a run's results: exports and releases, metrics, comparisons, statistics."""
