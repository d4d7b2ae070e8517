"""Tracks of people by their feet on the pitch plane, where views cannot triangulate."""
