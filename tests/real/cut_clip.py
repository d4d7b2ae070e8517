"""A moving camera cut out of a real static one: real images, with a known camera in every frame.

A static camera of the pair sees half of a pitch, in 3072 columns. A pinhole camera at the same
place turns and zooms inside of its image. Its clicks are those of the static camera, with their own
errors; its centre, rotation and focal length are known as well as the static camera.
"""

import json
from dataclasses import dataclass

import cv2
import numpy as np
import static_pair

from worldpose.geometry.cameras import Camera
from worldpose.geometry.rigid import Rigid
from worldpose.pitch.template import PitchTemplate
from worldpose.static_calibration.estimate import calibrate_camera
from worldpose.video.files import write_video
from worldpose.video.folder import open_video

SIZE = (1280, 720)
FRAMES, FPS = 150, 25.0
KEY_FRAMES = (0, 75, 149)
DRAWN_FRAMES = range(7, FRAMES, 15)
MOVES = {
    "pan": ((36.0, 2.0), (14.0, 0.0), (1500.0, 1500.0)),
    "zoom": ((32.0, 0.0), (24.0, 3.0), (1300.0, 2200.0)),
    "both": ((36.0, 2.0), (14.0, 0.0), (1300.0, 1900.0)),
}
"""First and last place at the middle of the image, x to the side [m]; focal lengths [px]."""


@dataclass(frozen=True, eq=False)
class CutClip:
    """The true camera of every frame, and the static camera it is cut from."""

    static: Camera
    pitch: PitchTemplate
    pixels: dict
    cameras: list

    def seen_from(self, camera, static_pixels):
        """Return the moving camera's pixels (n, 2) of pixels of the static one."""
        ways = self.static.unproject(static_pixels).directions
        return camera.project(camera.center + 100.0 * ways)


def calibrate_static(data, side):
    """Return a static camera and the pitch with its surface, from clicks and lines; the clicks."""
    named, clicks = static_pair.clicked_pitch(data, side)
    still = static_pair.median_still(data, side)
    found = calibrate_camera(named, clicks, static_pair.SIZE, picture=still).report.lines.estimate
    pixels = {point.name: point.xy for point in clicks.points}
    return found.camera, PitchTemplate.standard().with_surface(found.surface), pixels


def look_at(center, place, focal):
    """Return a level pinhole camera that has a place of the ground in the middle of its image."""
    ahead = np.append(place, 0.0) - center
    ahead /= np.linalg.norm(ahead)
    right = np.cross(ahead, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    rotation = np.stack([right, np.cross(ahead, right), ahead])
    return Camera(
        focal=np.full(2, focal),
        principal_point=0.5 * (np.array(SIZE) - 1.0),
        distortion=np.zeros(5),
        cam_from_world=Rigid(rotation, -rotation @ center),
        image_size=np.array(SIZE),
    )


def cut_clip(data, side, move):
    """Return the cameras of a clip: a smooth move within the static camera's image."""
    static, pitch, pixels = calibrate_static(data, side)
    first, last, zoom = MOVES[move]
    toward = np.array([-1.0 if side == "left" else 1.0, 1.0])
    share = np.linspace(0.0, 1.0, FRAMES)
    share = share**2 * (3.0 - 2.0 * share)
    places = toward * (first + share[:, None] * np.subtract(last, first))
    focal = np.exp(np.interp(share, [0.0, 1.0], np.log(zoom)))
    cameras = [
        look_at(static.center, place, each) for place, each in zip(places, focal, strict=True)
    ]
    return CutClip(static, pitch, pixels, cameras)


def pictures(data, side, clip):
    """Yield the images of the moving camera."""
    rows, columns = np.mgrid[: SIZE[1], : SIZE[0]]
    grid = np.column_stack([columns.ravel(), rows.ravel()]).astype(float)
    with open_video(data / f"{side}_camera.mp4") as video:
        for camera, (_, picture) in zip(clip.cameras, video.frames(0, FRAMES), strict=True):
            ways = camera.unproject(grid).directions
            there = clip.static.project(clip.static.center + 100.0 * ways)
            there = np.nan_to_num(there, nan=-1.0).astype(np.float32).reshape(*SIZE[::-1], 2)
            yield cv2.remap(picture, there, None, cv2.INTER_CUBIC)


def inside(pixels, size, border=0.0):
    """Return the mask of pixels (n, 2) in an image."""
    return ((pixels >= border) & (pixels <= np.array(size) - 1.0 - border)).all(axis=-1)


def write_moving_clip(data, side, move, folder):
    """Write clip.mp4, key_frames.json and lines.json, and return the clip with its truth."""
    clip = cut_clip(data, side, move)
    folder.mkdir(parents=True, exist_ok=True)
    write_video(folder / "clip.mp4", pictures(data, side, clip), FPS)
    laws = {name: pixel for name, pixel in clip.pixels.items() if name in clip.pitch.points}
    clicked, drawn = [], []
    for frame in KEY_FRAMES:
        seen = clip.seen_from(clip.cameras[frame], np.array(list(laws.values())))
        points = [
            {"name": name, "xy": pixel.tolist()}
            for name, pixel, is_seen in zip(laws, seen, inside(seen, SIZE, 5.0), strict=True)
            if is_seen
        ]
        clicked.append({"frame": frame, "markings": {"points": points}})
    for frame in DRAWN_FRAMES:
        lines = []
        for name in clip.pitch.white_names:
            places = clip.pitch.marking_points(name, 0.5)
            shown = clip.cameras[frame].project(places)
            both = inside(shown, SIZE) & inside(clip.static.project(places), static_pair.SIZE)
            if both.sum() >= 2 and name not in clip.pitch.goals:
                lines.append({"name": name, "xy": shown[both].tolist()})
        drawn.append({"frame": frame, "markings": {"drawn": lines}})
    for name, frames in (("key_frames", clicked), ("lines", drawn)):
        (folder / f"{name}.json").write_text(json.dumps({"key_frames": frames}))
    return clip
