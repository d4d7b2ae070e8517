"""Prefect and Dask for runs: their environment, servers, workers and failures."""
