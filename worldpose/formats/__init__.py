"""Exchange file formats, written from plain arrays and read back.

Joints, cameras, body poses, COCO keypoints, the FIFA skeletal tracking challenge, motion capture
(TRC, BVH); docs/reference/formats.md describes each of them. A reader checks types, shapes and
sizes before it uses them; its InputError names file and place of what is missing or invalid.
"""
