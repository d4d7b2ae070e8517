"""Matches of which there is nothing but small videos."""

import numpy as np
from run_records import calibration

from data_contracts.match import MatchSpec
from worldpose.ingest.writing import write_match
from worldpose.video.files import write_video

SIZE = (64, 48)


def write_filmed(folder, greys, clips, *, offsets=None):
    """Write the match folder of a match called filmed, at 25 frames per second.

    Args:
        folder: to be made.
        greys: of each camera, how bright each image of its video is.
        clips: name, first frame and number of frames of each.
        offsets: of cameras whose clocks differ [frame].
    """
    spec = {
        "match_id": "filmed",
        "fps": 25,
        "cameras": [
            {
                "id": name,
                "width": SIZE[0],
                "height": SIZE[1],
                "offset_frames": (offsets or {}).get(name, 0),
            }
            for name in greys
        ],
        "clips": [
            {"id": clip, "first_frame": first, "frame_count": count} for clip, first, count in clips
        ],
        "pitch": "none",
    }
    calibrations = {
        name: calibration(
            name,
            **{"image_size": SIZE, "focal_px": (50.0, 50.0), "principal_point_px": (31.5, 23.5)},
            **{"rotation": np.eye(3).tolist(), "translation": (0.01 * n, 0.0, 5.0)},
        )
        for n, name in enumerate(greys)
    }

    def film(folder):
        (folder / "videos").mkdir()
        for name, bright in greys.items():
            pictures = [np.full((SIZE[1], SIZE[0], 3), grey, np.uint8) for grey in bright]
            write_video(folder / "videos" / f"{name}.mp4", pictures, 25.0, quality=5)

    spec = MatchSpec.model_validate(spec)
    write_match(folder, spec, calibrations=calibrations, observations={}, further=film)
