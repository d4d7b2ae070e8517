"""The two static cameras of a real match as a match folder, from their videos and hand clicks.

The clicks are CVAT annotations whose labels "(x,y)" are metres from the far left corner of a
105 x 68 m pitch. Places that the Laws do not name, where mowing stripes meet the touch lines,
become points of pitch.json. Both cameras hang on one mast, 0.46 m apart.
"""

import json
import shutil
import xml.etree.ElementTree as ElementTree

import numpy as np

from data_contracts.pitch import PitchSpec
from data_contracts.static_calibration import ClickedMarkings, ClickedPoint
from worldpose.pitch.laws import prescribed_points
from worldpose.pitch.template import PitchTemplate
from worldpose.video.folder import median_picture, open_video

CROWN = 0.1
"""Height of the long axis above the touch lines [m]; it fits both cameras better than 0.2."""
LENGTH, WIDTH = 105.0, 68.0
SIZE = (3072, 1728)
SWAPPED = {("right", 1394.99): "(88.5,14.84)", ("right", 2945.60): "(99.5,68)"}
"""Two clicks of the right camera whose labels are swapped: pixel x to the label of the place."""
TRUE_CORNER = {14.84: 13.84, 53.16: 54.16}
"""The labels draw the penalty areas 1 m too narrow on either side [m]."""


def read_clicks(data, side, *, correct_labels=True):
    """Return name to place (2,) [m, world] and name to pixel (2,) of one camera.

    Args:
        data: folder of the pair.
        side: left or right.
        correct_labels: use the places that were clicked instead of those that the labels say. A
            label that comes twice gets the suffix `.again`.
    """
    places, pixels = {}, {}
    laws = prescribed_points(PitchSpec(), (LENGTH, WIDTH))
    for point in ElementTree.parse(data / f"{side}_keypoints.xml").iter("points"):
        pixel = tuple(map(float, point.get("points").split(",")))
        label = point.get("label")
        if correct_labels:
            label = SWAPPED.get((side, round(pixel[0], 2)), label)
        x, y = map(float, label.strip("()").split(","))
        if correct_labels:
            y = TRUE_CORNER.get(y, y)
        x, y = x - 0.5 * LENGTH, 0.5 * WIDTH - y
        place = np.array([x, y])
        on_ground = {name: law for name, law in laws.items() if law[2] == 0.0}
        near = [name for name, law in on_ground.items() if np.hypot(*(place - law[:2])) < 0.1]
        name = near[0] if near else f"stripe.{label.strip('()').replace(',', '.')}"
        name = f"{name}.again" if name in pixels else name
        places[name], pixels[name] = place, pixel
    return places, pixels


SIDES = {"left": 4, "right": 0}
"""Offset of each camera's frames; the left video is four frames late."""


def median_still(data, side):
    """Return the median of frames 8 to 47 (height, width, 3) RGB of one camera."""
    with open_video(data / f"{side}_camera.mp4") as video:
        numbers = (SIDES[side] + np.linspace(8, 47, 25)).astype(int).tolist()
        shown = (image for number in numbers for _, image in video.frames(number, number + 1))
        return median_picture(shown, len(numbers))


def clicked_pitch(data, side):
    """Return the pitch with the clicked places as points, and the clicks of one camera."""
    places, pixels = read_clicks(data, side)
    points = {name: tuple(place) for name, place in places.items()}
    clicks = tuple(ClickedPoint(name=name, xy=pixel) for name, pixel in pixels.items())
    pitch = PitchTemplate.from_spec(PitchSpec(crown=CROWN, points=points))
    return pitch, ClickedMarkings(points=clicks)


def write_static_pair(
    data,
    folder,
    *,
    sides=tuple(SIDES),
    first_frame=8,
    frame_count=10,
    correct_labels=True,
    clicked=True,
):
    """Write the match folder: both videos or one, their clicks or their side, and one clip."""
    annotations = folder / "annotations" / "static_calibration"
    (folder / "videos").mkdir(parents=True)
    if clicked:
        annotations.mkdir(parents=True)
    points = {}
    for side in sides:
        shutil.copy(data / f"{side}_camera.mp4", folder / "videos" / f"{side}.mp4")
        if not clicked:
            continue
        places, pixels = read_clicks(data, side, correct_labels=correct_labels)
        laws = prescribed_points(PitchSpec(), (LENGTH, WIDTH))
        points |= {name: list(place) for name, place in places.items() if name not in laws}
        clicked = [{"name": name, "xy": list(pixel)} for name, pixel in pixels.items()]
        (annotations / f"{side}.json").write_text(json.dumps({"points": clicked}))
    pitch = {"length": LENGTH, "width": WIDTH, "crown": CROWN, "points": points}
    (folder / "pitch.json").write_text(json.dumps(pitch))
    cameras = "".join(
        f"  - {{id: {side}, width: {SIZE[0]}, height: {SIZE[1]}, offset_frames: {SIDES[side]}"
        f"{'' if clicked else ', side: near'}}}\n"
        for side in sides
    )
    (folder / "match.yaml").write_text(
        f"""contract: 1
match_id: {"pair" if len(sides) == 2 else sides[0]}
fps: 25
cameras:
{cameras}clips:
  - {{id: clip, first_frame: {first_frame}, frame_count: {frame_count}}}
"""
    )
