"""Synthetic: match folders with known truth, from a scenario and a seed.

Inputs: a `Scenario` (people, cameras, detector errors) and a seed.
Outputs: a `Scene` in memory, a match folder with `reference/`, or images of it.
"""
