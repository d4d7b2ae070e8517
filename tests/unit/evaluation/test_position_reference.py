"""Positions of a provider against joints: forms, axes, names and what cannot be compared."""

import numpy as np
import pytest

from worldpose.errors import InputError
from worldpose.evaluation.metrics import evaluate_joints
from worldpose.evaluation.position_reference import align_positions, read_positions
from worldpose.formats.joints_file import JointTracks

NAMES = ("home_11", "away_4", "home_7")


def tracks():
    """Three people who walk apart; their hips are 0.9 m high."""
    frames = np.arange(100, 130)
    start = np.array([[-20.0, 8.0], [3.0, -5.0], [30.0, 12.0]])
    way = np.array([[0.1, 0.0], [0.0, 0.2], [-0.1, 0.1]])
    places = start + (frames - 100)[:, None, None] * way
    joints = np.full((30, 3, 17, 3), np.nan)
    joints[:, :, [11, 12], :2] = places[:, :, None] + [[-0.15, 0.0], [0.15, 0.0]]
    joints[:, :, [11, 12], 2] = 0.9
    return JointTracks(frames, np.array([4, 5, 9]), joints), places


def wide(places, first=0):
    lines = ["period_id,frame_id,ball_x,ball_y," + ",".join(f"{n}_x,{n}_y,{n}_s" for n in NAMES)]
    for n, row in enumerate(places.tolist()):
        lines.append(f"1,{first + n},0,0," + ",".join(f"{x:.3f},{y:.3f},1.5" for x, y in row))
    return "\n".join(lines)


def long(places, first=0):
    lines = ["frame_id,player_id,x,y"]
    for n, row in enumerate(places.tolist()):
        people = [("ball", (0.0, 0.0)), *zip(NAMES, row, strict=True)]
        lines += [f"{first + n},{name},{x:.3f},{y:.3f}" for name, (x, y) in people]
    return "\n".join(lines)


@pytest.mark.parametrize("form", [wide, long])
@pytest.mark.parametrize("way", [(1, 1), (-1, -1), (1, -1)])
def test_places_of_every_form_and_way_name_the_people(tmp_path, form, way):
    mine, places = tracks()
    file = tmp_path / "positions.csv"
    file.write_text(form((places + [0.0, 0.1]) * way, first=7000))
    predicted, given, notes = align_positions(file, mine, 100)
    assert notes[-1] == "people: {4: home_11, 5: away_4, 9: home_7}"
    assert len(notes) == 1 + (way != (1, 1))
    scores, _ = evaluate_joints(predicted, given, fps=25.0)
    assert scores.mpjpe_mm == pytest.approx(100.0)
    assert (scores.coverage, scores.switches, scores.persons) == (1.0, 0, 3)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda places: places / [105.0, 68.0] + 0.5, "metres from the centre spot"),
        (lambda places: 100.0 * places, "metres from the centre spot"),
        (lambda places: places + [5.0, 0.0], "people of the match, one way round"),
        (lambda places: places * [0.0, 1.0], "people of the match, one way round"),
    ],
)
def test_places_in_other_units_or_of_others_are_refused(tmp_path, change, words):
    mine, places = tracks()
    file = tmp_path / "positions.csv"
    file.write_text(wide(change(places), first=100))
    with pytest.raises(InputError, match=words):
        align_positions(file, mine)


@pytest.mark.parametrize(
    "text", ["", "a,b\n1,2\n", "frame_id,p_x\n1,2\n", "frame,p_x,p_y\n1,a,2\n"]
)
def test_other_files_are_refused(tmp_path, text):
    (tmp_path / "positions.csv").write_text(text)
    with pytest.raises(InputError, match="to_df"):
        read_positions(tmp_path / "positions.csv")
