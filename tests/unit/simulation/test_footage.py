import av
import cv2
import numpy as np
import pytest

from worldpose.formats.joints_file import read_joints
from worldpose.ingest.match_folder import read_match
from worldpose.simulation.matches import MatchOptions, simulate_match
from worldpose.simulation.scenarios import SCENARIOS

SMALL = SCENARIOS["tiny"].model_copy(
    update={
        # A third of the usual size: a ninth of the time.
        "rig": SCENARIOS["tiny"].rig.model_copy(
            update={"cameras": 1, "image_size_px": (640, 360), "person_height_px": 40.0}
        ),
        "broadcast": None,
    }
)


@pytest.fixture(scope="module")
def match(tmp_path_factory):
    folder, progress = tmp_path_factory.mktemp("rendered") / "tiny", []
    options = MatchOptions(duration=0.2, render=True, masks=True)
    simulate_match(SMALL, 1, folder, options, advance=lambda *each: progress.append(each))
    return folder, progress


def test_a_rendered_match_has_pixels_and_nothing_that_a_detector_said(match):
    folder, progress = match
    read = read_match(folder)
    assert list((folder / "detections").iterdir()) == []
    assert not (folder / "reference" / "identities").exists()
    assert list(read.spec.cameras) == list(read.spec.static_cameras)
    with av.open(str(folder / "videos" / "cam00.mp4")) as video:
        frames = [frame.to_ndarray(format="rgb24") for frame in video.decode(video=0)]
    assert [frame.shape for frame in frames] == [(360, 640, 3)] * 5
    still = cv2.imread(str(folder / "stills" / "cam00.png"))[..., ::-1]
    # The still is the first frame but for the codec: within its quantisation on average.
    assert np.abs(frames[0].astype(float) - still).mean() < 6.0
    assert progress == [("cam00", done, 5) for done in range(1, 6)]


def test_masks_and_boxes_have_everybody_where_the_joints_project(match):
    folder, _ = match
    truth = read_joints(folder / "reference" / "joints.npz")
    calibration = read_match(folder)
    assert calibration.spec.clips[0].frame_count == 5
    with np.load(folder / "reference" / "cameras" / "cam00.npz") as camera:
        k, turn, shift = camera["K"][0], camera["R"][0], camera["t"][0]
        lens = camera["k"][0]
    with np.load(folder / "reference" / "boxes" / "cam00.npz") as truth_boxes:
        boxes, visible = truth_boxes["boxes"], truth_boxes["visible"]
    assert boxes.shape == (5, 5, 4)
    seen = 0
    for frame in range(5):
        mask = cv2.imread(
            str(folder / "reference" / "masks" / "cam00" / f"{frame:06d}.png"), cv2.IMREAD_UNCHANGED
        )
        for person in range(5):
            if visible[frame, person] < 0.99:
                continue
            hip = truth.joints[frame, person, 11:13].mean(axis=0)
            (pixel,) = cv2.projectPoints(hip[None], cv2.Rodrigues(turn)[0], shift, k, lens)[0][0]
            u, v = np.rint(pixel).astype(int)
            if 0 <= u < 640 and 0 <= v < 360:
                assert mask[v, u] == person + 1
                left, top, right, bottom = boxes[frame, person]
                assert left < pixel[0] < right
                assert top < pixel[1] < bottom
                seen += 1
    assert seen >= 10
