"""Pitch model: named points, painted markings and surface height.

Input: a `PitchSpec` with surveyed points, or none; a surveyor's file. Output: a template in world
metres for calibration, drawing and filtering; a survey in the world frame
(`worldpose.pitch.survey`).
"""
