from dataclasses import replace

import numpy as np
import pytest

from worldpose.errors import InputError
from worldpose.simulation.gait import walk
from worldpose.simulation.matches import MatchOptions, simulate_match
from worldpose.simulation.paths import MARGIN, STEP, GroundPath
from worldpose.simulation.recordings import NAMES, clip_path, read_bvh, read_clip, read_trajectories
from worldpose.simulation.scenarios import SCENARIOS
from worldpose.simulation.skeletons import draw_body

CHANNELS = "CHANNELS 3 Zrotation Yrotation Xrotation"
TREE = {
    # name: parent, offset from it [cm], y up, facing z, left is x
    "hip": (None, (0, 0, 0)),
    "lThigh": ("hip", (9, 0, 0)),
    "lShin": ("lThigh", (0, -40, 0)),
    "lFoot": ("lShin", (0, -41, 0)),
    "rThigh": ("hip", (-9, 0, 0)),
    "rShin": ("rThigh", (0, -40, 0)),
    "rFoot": ("rShin", (0, -41, 0)),
    "neck": ("hip", (0, 50, 0)),
    "head": ("neck", (0, 15, 0)),
    "lShldr": ("neck", (18, 0, 0)),
    "lForeArm": ("lShldr", (0, -28, 0)),
    "lHand": ("lForeArm", (0, -26, 0)),
    "rShldr": ("neck", (-18, 0, 0)),
    "rForeArm": ("rShldr", (0, -28, 0)),
    "rHand": ("rForeArm", (0, -26, 0)),
}
FRAMES = 120


def text(scale=1.0):
    """A person who walks along z, bends knees and elbows, leans and turns; one of `TREE`."""

    def joint(name, depth):
        parent, offset = TREE[name]
        pad = "  " * depth
        kind = "ROOT" if parent is None else "JOINT"
        channels = (
            CHANNELS if parent else CHANNELS.replace("3 ", "6 Xposition Yposition Zposition ")
        )
        children = [other for other, (above, _) in TREE.items() if above == name]
        end = "" if children else f"{pad}End Site {{ OFFSET 0 {-scale} 0 }}\n"
        inner = "".join(joint(child, depth + 1) for child in children)
        place = " ".join(str(scale * value) for value in offset)
        opened = f"{pad}{kind} {name}\n{pad}{{\n{pad}OFFSET {place}\n{pad}{channels}\n"
        return f"{opened}{inner}{end}{pad}}}\n"

    order = []

    def visit(name):
        order.append(name)
        for child, (above, _) in TREE.items():
            if above == name:
                visit(child)

    visit("hip")
    time = np.arange(FRAMES) / 60.0
    rows = np.zeros((FRAMES, 3 + 3 * len(order)))
    rows[:, 1] = scale * (85.0 - 3.0 * np.sin(3.0 * time) ** 2)
    rows[:, 2] = scale * 120.0 * time

    def turn(name, axis, degrees):
        rows[:, 3 + 3 * order.index(name) + "ZYX".index(axis)] = degrees

    turn("hip", "Y", 20.0 * time)
    turn("lThigh", "X", -30.0 * np.sin(5.0 * time))
    turn("lShin", "X", 40.0 * np.sin(5.0 * time) ** 2)
    turn("rThigh", "X", 30.0 * np.sin(5.0 * time))
    turn("rShin", "X", 30.0 + 0.0 * time)
    turn("neck", "X", 10.0 * np.cos(time))
    turn("lShldr", "Z", 30.0 + 20.0 * np.sin(time))
    turn("lForeArm", "X", -70.0 * np.sin(4.0 * time) ** 2)
    turn("rForeArm", "Y", 15.0 * time)
    motion = "\n".join(" ".join(f"{value:.9f}" for value in row) for row in rows)
    head = f"MOTION\nFrames: {FRAMES}\nFrame Time: {1 / 60:.12f}\n"
    return "HIERARCHY\n" + joint("hip", 0) + head + motion + "\n"


def stood(heading=0.0, x=0.0, y=0.0):
    time = np.arange(round((4.0 + 2 * MARGIN) / STEP) + 1) * STEP - MARGIN
    return GroundPath(
        time, np.tile([x, y], (len(time), 1)), np.full(len(time), heading), np.zeros(len(time))
    )


@pytest.fixture
def file(tmp_path):
    path = tmp_path / "walk.bvh"
    path.write_text(text())
    return path


def same_build():
    """A body with the skeleton's own lengths [m]."""
    body = draw_body((1.8, 1.8), np.random.default_rng(0))
    lengths = {"thigh": 0.40, "shank": 0.41, "upper_arm": 0.28, "forearm": 0.26, "trunk": 0.50}
    return replace(body, **lengths, hip_half_width=0.09, shoulder_half_width=0.18)


def test_a_played_clip_is_the_files_forward_kinematics(file):
    capture, clip, body = read_bvh(file), read_clip(file), same_build()
    path = clip_path(clip, stood(), body)
    times = np.arange(60) / 60.0
    joints = walk(body, path, times, lambda x, y: 0.0 * x, np.random.default_rng(0))
    order = [spelling for spellings in NAMES.values() for spelling in spellings[:1]][:12]
    expected = capture.positions[:60, [capture.names.index(name) for name in order]]
    # y up, facing z, in centimetres, becomes z up, facing x, in metres.
    expected = 0.01 * expected[..., [2, 0, 1]]
    shift = joints[:, 5:] - expected
    # One shift for all: the start is at the origin and the floor at the ground; nine decimals of
    # degrees and centimetres over a chain of 1 m.
    np.testing.assert_allclose(shift, np.broadcast_to(shift[0, 0], shift.shape), atol=1e-8)
    np.testing.assert_allclose(shift[0, 0, :2], 0.0, atol=1e-8)
    lowest = read_bvh(file).positions[:, [capture.names.index("lFoot")], 1].min()
    assert joints[:, 15:, 2].min() == pytest.approx(0.08, abs=0.02), lowest


@pytest.mark.parametrize("scale", [0.01, 0.393701, 10.0, 0.177165])
def test_units_are_told_by_the_length_of_legs(scale, file, tmp_path):
    (tmp_path / "other.bvh").write_text(text(scale))
    # Inches and the CMU unit are given here to six digits.
    np.testing.assert_allclose(
        read_clip(tmp_path / "other.bvh").points, read_clip(file).points, atol=1e-4
    )


def test_joints_in_an_npz_are_played_too(file, tmp_path):
    capture = read_bvh(file)
    np.savez(
        tmp_path / "clip.npz",
        joints=capture.positions,
        joint_names=np.array(capture.names),
        fps=60.0,
    )
    clip = read_clip(tmp_path / "clip.npz")
    np.testing.assert_allclose(clip.points, read_clip(file).points, atol=1e-12)
    np.savez(tmp_path / "bad.npz", joints=capture.positions)
    with pytest.raises(InputError, match="fps"):
        read_clip(tmp_path / "bad.npz")


def test_a_joint_that_is_missing_is_named(tmp_path):
    (tmp_path / "clip.bvh").write_text(text().replace("lForeArm", "elbow"))
    with pytest.raises(InputError, match="left elbow"):
        read_clip(tmp_path / "clip.bvh")


TIME = np.arange(0.0, 6.0, 0.1)


def tracked(path, **changes):
    """A person who runs along x at 4 m/s, and a standing one."""
    runner = np.stack([4.0 * TIME - 10.0, 0.0 * TIME + 5.0], axis=-1)
    keeper = np.tile([-50.0, 1.0], (len(TIME), 1))
    content = {"xy": np.stack([runner, keeper], axis=1), "time": TIME + 100.0, **changes}
    np.savez(path, **{name: value for name, value in content.items() if value is not None})
    return path


def test_paths_follow_the_data(tmp_path):
    (runner, keeper), length = read_trajectories(tracked(tmp_path / "t.npz"), 60.0)
    assert length == pytest.approx(5.9, abs=1e-9)
    assert runner.time[0] == pytest.approx(-MARGIN)
    assert runner.time[-1] == pytest.approx(length + MARGIN, abs=0.01)
    inner = (runner.time >= 0.5) & (runner.time <= 5.4)
    # Smoothing leaves a straight run as it is; its ends are coasted half a second further in.
    np.testing.assert_allclose(
        runner.position[inner],
        np.stack([4 * runner.time - 10, 0 * runner.time + 5], -1)[inner],
        atol=1e-3,
    )
    np.testing.assert_allclose(runner.speed[inner], 4.0, atol=0.01)
    np.testing.assert_allclose(runner.heading, 0.0, atol=1e-9)
    np.testing.assert_allclose(keeper.position, np.tile([-50.0, 1.0], (len(keeper.time), 1)))
    assert keeper.speed.max() < 1e-9


@pytest.mark.parametrize(
    ("changes", "found"),
    [
        ({"xy": np.zeros((60, 2))}, "xy of shape"),
        ({"xy": np.full((60, 2, 2), np.nan)}, "0 people"),
        ({"time": None}, "neither time nor fps"),
        ({"time": np.zeros(3)}, r"time \(3,\)"),
        ({"xy": np.zeros((2, 2, 2)), "time": np.arange(2.0)}, "2 samples"),
        ({"time": np.zeros(60)}, "1 samples"),
        ({"xy": np.array([None])}, "never loaded"),
    ],
)
def test_unusable_files_are_refused(tmp_path, changes, found):
    with pytest.raises(InputError, match=found):
        read_trajectories(tracked(tmp_path / "t.npz", **changes), 60.0)


def test_a_match_is_driven_by_them_and_its_id_names_the_file(tmp_path):
    file = tracked(tmp_path / "t.npz")
    spec = simulate_match(
        SCENARIOS["match"],
        1,
        tmp_path / "m",
        MatchOptions(duration=0.4, cameras=2, trajectories=file),
    )
    assert spec.match_id.startswith("match-1-0.4s-2cameras-tracks")
    assert spec.clips[0].frame_count == 20
    with np.load(tmp_path / "m" / "reference" / "joints.npz") as truth:
        assert truth["joints"].shape == (20, 2, 17, 3)
