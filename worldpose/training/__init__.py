"""Training of the bundled nets on labelled frames, rendered or reviewed.

Input: COCO keypoints data sets. Output: safetensors weights that `worldpose.detection` takes,
and metrics (AP50, PCK) before and after. Only the training of nets needs torch.
"""
