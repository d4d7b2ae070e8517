"""Multi-view tracking: association of every camera's detections with people, over time.

Inputs: cameras and the detections of each. Outputs: the detection of every person in every frame
and camera, quick joints [m], and a summary of each track.
"""
