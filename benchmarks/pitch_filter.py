"""Prints errors of the pitch filter (D2), which removes spectators, in rendered images.

    python benchmarks/pitch_filter.py [--scenario match] [--seeds 3] [--pictures FOLDER]

One image of every static camera, true cameras, embedded nets; boxes of low score count, too. Stage
`detection` searches for people twice: everywhere, and on the pitch and close to it. A player,
referee or assistant counts if at least half of the person is visible; a box belongs to the person
that it overlaps by 0.3. Bystanders stand 2.5 to 3.3 m behind the lines. Of the other false
positives, a box is in the stands if its middle shows no ground up to 8 m behind the lines; the rest
is goals, shadows and parts of people.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from data_contracts.arrays import Floats, Image
from worldpose.detection.models import load_bundled_detector, load_bundled_pose
from worldpose.detection.pipeline import PeopleFinder, Place
from worldpose.detection.settings import DetectionSettings
from worldpose.geometry.boxes import box_iou
from worldpose.geometry.cameras import Camera
from worldpose.pitch.template import PitchTemplate
from worldpose.simulation.cast import assign_roles, dress_people, place_bystanders
from worldpose.simulation.image_formation import RenderedFrame
from worldpose.simulation.matches import open_view, render_frame
from worldpose.simulation.scenarios import SCENARIOS
from worldpose.simulation.scene import simulate_scene
from worldpose.simulation.settings import Scenario

SEEN = 0.5
"""Minimum visible share of a person that counts as to be found."""
SHARED = 0.3
"""Minimum overlap of a box with a person's outline."""
STANDS = 8.0
"""Distance behind the lines [m]; the middle of a person before the boards shows nearer ground."""
KEPT, TAKEN = (0, 200, 0), (220, 0, 0)


def main() -> None:
    """Print one line per seed."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--scenario", default="match")
    parser.add_argument("--seeds", type=int, nargs="+", default=[3])
    parser.add_argument("--pictures", type=Path, help="draw what was kept and what taken")
    asked = parser.parse_args()
    scenario = SCENARIOS[asked.scenario].model_copy(update={"duration": 0.2, "broadcast": None})
    pitch = PitchTemplate.from_spec(scenario.pitch)
    settings = DetectionSettings(high_score_threshold=DetectionSettings().low_score_threshold)
    finder = PeopleFinder([load_bundled_detector()], load_bundled_pose(), settings)
    for seed in asked.seeds:
        counts = np.zeros((5, 2), int)
        for name, camera, frame, bystanders in film(scenario, pitch, seed):
            found = boxes_of(finder, frame.image, None)
            on_pitch = boxes_of(finder, frame.image, Place(camera, pitch))
            players = frame.boxes[frame.visible >= SEEN]
            counts[0] += len(players), np.count_nonzero(overlaps_any(players, found))
            kept = overlaps_any(found, on_pitch, 0.99)
            is_player = overlaps_any(found, frame.boxes[frame.visible > 0.0])
            is_bystander = ~is_player & overlaps_any(found, bystanders)
            is_other = ~(is_player | is_bystander)
            is_stand = is_other & in_stands(found, camera, pitch)
            kinds = (is_player, is_bystander, is_stand, is_other & ~is_stand)
            for row, chosen in enumerate(kinds, 1):
                counts[row] += np.count_nonzero(chosen), np.count_nonzero(chosen & ~kept)
            if asked.pictures is not None:
                draw(asked.pictures / f"{seed}-{name}.png", frame.image, found, kept)
        (players, seen), *boxes = counts.tolist()
        words = ("players", "bystanders", "the stands", "other things")
        taken = ", ".join(
            f"{out} of {all_} boxes of {word}"
            for word, (all_, out) in zip(words, boxes, strict=True)
        )
        print(
            f"{scenario.name} {seed}: {seen} of {players} players found; crowd: {taken}", flush=True
        )


def film(
    scenario: Scenario, pitch: PitchTemplate, seed: int
) -> Iterator[tuple[str, Camera, RenderedFrame, Floats]]:
    """Yield every static camera, its first image and the boxes of bystanders (n, 4) [px]."""
    scene = simulate_scene(scenario, seed)
    poses = scene.crowd.poses(np.zeros(1))
    roles = assign_roles(scenario.crowd, len(scene.crowd.paths))
    cast = dress_people(poses.betas[:, 0], roles, seed, scenario.look.patterns)
    surfaces = cast.pose(poses[:, 0])
    bystanders = place_bystanders(pitch, scenario.look.bystanders, seed)
    for name, camera in scene.cameras.items():
        view = open_view(camera, pitch, seed, scenario.look)
        outlines = [camera.project(prop.surfaces.vertices[0].astype(float)) for prop in bystanders]
        boxes = np.array([[*points.min(axis=0), *points.max(axis=0)] for points in outlines])
        yield (
            name,
            camera,
            render_frame(view, cast, surfaces, props=bystanders),
            boxes[np.isfinite(boxes).all(axis=1)],
        )


def boxes_of(finder: PeopleFinder, picture: Image, place: Place | None) -> Floats:
    """Return the boxes (n, 4) [px] that stage `detection` would store for an image."""
    (found,) = finder.find([(0, picture)], place)
    boxes = found.boxes[0].astype(float)
    return np.asarray(boxes[np.isfinite(boxes).all(axis=1)])


def in_stands(boxes: Floats, camera: Camera, pitch: PitchTemplate) -> NDArray[np.bool_]:
    """Return whether each box's middle shows a place far behind the lines, or no ground (n,)."""
    rays = camera.unproject(0.5 * (boxes[:, :2] + boxes[:, 2:]))
    with np.errstate(divide="ignore", invalid="ignore"):
        along = -rays.origins[:, 2] / rays.directions[:, 2]
        ground = np.abs(rays.origins + along[:, None] * rays.directions)
    near = (ground[:, 0] <= pitch.length / 2 + STANDS) & (ground[:, 1] <= pitch.width / 2 + STANDS)
    return ~(near & (along > 0.0))


def overlaps_any(boxes: Floats, others: Floats, share: float = SHARED) -> NDArray[np.bool_]:
    """Return whether each box overlaps any of the others by a share (n,)."""
    if not len(others):
        return np.zeros(len(boxes), bool)
    return np.asarray(box_iou(boxes, others).max(axis=1) >= share)


def draw(file: Path, picture: Image, boxes: Floats, kept: NDArray[np.bool_]) -> None:
    """Write the image with kept people in green and removed ones in red."""
    drawn = picture.copy()
    for box, is_kept in zip(boxes.round().astype(int), kept, strict=True):
        cv2.rectangle(drawn, box[:2].tolist(), box[2:].tolist(), KEPT if is_kept else TAKEN, 2)
    file.parent.mkdir(parents=True, exist_ok=True)
    cv2.imwrite(str(file), drawn[..., ::-1])


if __name__ == "__main__":
    main()
