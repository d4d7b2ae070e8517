"""Prefect tasks, one retriable unit each: read the inputs, call worldpose, publish the result."""
