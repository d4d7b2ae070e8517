"""Detection of people in each camera's frames, with boxes and keypoints.

Inputs: frames in order, detectors and a pose estimator, the calibrated camera and the pitch.
Outputs: `KeypointDetections` in chunks of frames, without the crowd.
"""
