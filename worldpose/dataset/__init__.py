"""Released data sets: manifest, statistics, and validation."""
