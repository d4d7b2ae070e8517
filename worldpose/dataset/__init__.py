"""Released data sets: manifest, statistics, and validation; InputError names file and place."""
