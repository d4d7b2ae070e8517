"""Ingest: validated records and dense arrays from a match folder.

Inputs: match.yaml, calibration.toml, clicked markings, detections/, pitch.json, videos; or files of
other tools.
Outputs: `MatchFolder`, `Registration`, `KeypointDetections` on match frames; or an InputError that
names the file and the entry or key that is missing or invalid.
"""
