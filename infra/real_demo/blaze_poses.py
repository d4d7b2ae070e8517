"""Writes 2D poses with feet of a video with one person, in OpenPose's JSON of HALPE-26.

    python -m venv VENV
    VENV/bin/pip install "mediapipe==0.10.14" "numpy<2" "opencv-python-headless<4.11" "protobuf<5"
    VENV/bin/python infra/real_demo/blaze_poses.py VIDEO.mp4 OUT_json

MediaPipe's BlazePose (Apache-2.0), whose weights are in its wheel, is called; nothing of it is
copied here. Its `foot_index` is written as the big toe. It gives no small toes, whose confidence is
0, as is that of head, neck and mid-hip.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path

import cv2
import mediapipe  # type: ignore[import-not-found]  # in an environment of its own

# Places in HALPE-26 of the points of BlazePose.
PLACES = {
    **dict(zip((0, 2, 5, 7, 8), range(5), strict=True)),
    **dict(zip(range(11, 17), range(5, 11), strict=True)),
    **dict(zip(range(23, 29), range(11, 17), strict=True)),
    31: 20,
    32: 21,
    29: 24,
    30: 25,
}


def main() -> None:
    """Write one file for each frame."""
    video, out = Path(sys.argv[1]), Path(sys.argv[2])
    out.mkdir(parents=True)
    pose = mediapipe.solutions.pose.Pose(model_complexity=1, smooth_landmarks=False)
    capture = cv2.VideoCapture(str(video))
    frame = 0
    while True:
        read, image = capture.read()
        if not read:
            break
        height, width = image.shape[:2]
        found = pose.process(cv2.cvtColor(image, cv2.COLOR_BGR2RGB)).pose_landmarks
        people = []
        if found is not None:
            values = [0.0] * (3 * 26)
            for source, place in PLACES.items():
                point = found.landmark[source]
                # Its pixels begin at the corner of the image, ours at the centre of a pixel.
                values[3 * place : 3 * place + 3] = [
                    point.x * width - 0.5,
                    point.y * height - 0.5,
                    max(point.visibility, 1e-3),
                ]
            people = [{"person_id": [-1], "pose_keypoints_2d": values}]
        file = out / f"{video.stem}_{frame:06d}.json"
        file.write_text(json.dumps({"version": 1.3, "people": people}))
        frame += 1
    print(f"{video.name}: {frame} frames")


if __name__ == "__main__":
    main()
