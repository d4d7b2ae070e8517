"""Orchestration: the paper's method as Prefect flows, and the command line."""
