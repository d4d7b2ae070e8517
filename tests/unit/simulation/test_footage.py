import av
import cv2
import numpy as np
import pytest

from worldpose.body import BodyParameters, load_open_body
from worldpose.formats import read_joints
from worldpose.geometry import Camera
from worldpose.ingest import read_match
from worldpose.pitch import PitchTemplate
from worldpose.simulation import SCENARIOS, MatchOptions, simulate_match
from worldpose.simulation.cast import dress_people, place_bystanders
from worldpose.simulation.image_formation import cluster_boxes
from worldpose.simulation.mannequins import open_mannequin, pose_people, shape_people
from worldpose.simulation.matches import open_view, render_frame
from worldpose.simulation.scene import look_at
from worldpose.simulation.settings import RenderingSettings

PITCH = PitchTemplate.standard()
PLAIN = RenderingSettings(noise=0.0, stand_shadow=0.0)
ARMS_DOWN = 1.2


def people(places, turn=0.0):
    """Bodies that stand at places (n, 2) with their arms down, facing -y."""
    pose = np.zeros((len(places), 23, 3))
    pose[:, 15, 2], pose[:, 16, 2] = -ARMS_DOWN, ARMS_DOWN
    places = np.asarray(places, dtype=float)
    height = PITCH.height(places[:, 0], places[:, 1]) + 1.2
    return BodyParameters(
        np.zeros((len(places), 10)),
        np.array([np.pi / 2.0, 0.0, 0.0]),
        pose.reshape(len(places), 69),
        np.column_stack([places, height]),
    )


def camera(place=(-30.0, -60.0, 18.0), aim=(-30.0, -10.0, 0.0), k1=-0.2):
    return Camera(
        focal=np.array([1100.0, 1100.0]),
        principal_point=np.array([242.0, 131.0]),
        distortion=np.array([k1, 0.05, 0.002, -0.001, 0.01]),
        cam_from_world=look_at(np.array(place), np.array(aim), 0.01),
        image_size=np.array([480, 270]),
    )


def cv_pixels(view, points):
    fx, fy = view.focal
    cx, cy = view.principal_point
    matrix = np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])
    pose = view.cam_from_world
    pixels, _ = cv2.projectPoints(
        points, pose.rotvec, pose.translation, matrix, np.array(view.distortion)
    )
    return pixels.reshape(-1, 2)


PLACES = [(-30.0, -10.0), (-36.0, -6.0), (-24.0, -12.0)]


@pytest.fixture(scope="module")
def view():
    return open_view(camera(), PITCH, 3, PLAIN)


@pytest.fixture(scope="module")
def cast():
    return dress_people(np.zeros((3, 10)), ["first", "second", "official"], 3)


def test_boxes_are_opencvs_and_masks_are_under_the_mid_hips(view, cast):
    poses = people(PLACES)
    surfaces = cast.pose(poses)
    frame = render_frame(view, cast, surfaces)
    joints = load_open_body().joints(poses)
    for person in range(3):
        pixels = cv_pixels(view.camera, surfaces.vertices[person].astype(np.float64))
        expected = [*pixels.min(axis=0), *pixels.max(axis=0)]
        # Single precision of 60 m and of 480 px.
        np.testing.assert_allclose(frame.boxes[person], expected, atol=2e-3)
        hip = cv_pixels(view.camera, joints[person, 1:3].mean(axis=0)[None])[0]
        u, v = np.rint(hip).astype(int)
        assert frame.person_ids[v, u] == person
        rows, columns = np.nonzero(frame.person_ids == person)
        # A shape that fills half a pixel reaches its border within a pixel.
        found = [columns.min(), rows.min(), columns.max(), rows.max()]
        np.testing.assert_allclose(found, expected, atol=1.5)
    np.testing.assert_array_equal(frame.visible, 1.0)


def test_mannequins_have_the_bodys_vertices_under_their_clothes():
    poses = people(PLACES)
    mannequin = open_mannequin()
    body = mannequin.body.vertices(poses)[:, mannequin.kept]
    posed = pose_people(mannequin, shape_people(mannequin, poses.betas), poses).vertices
    # Clothes stand off by 5 cm at most, and some skin is bare. Joints blend four bones, not six.
    away = np.linalg.norm(posed - body, axis=-1)
    assert away.max() < 0.06
    assert np.median(away[:, mannequin.clothed[:, 0] > 0.5]) < 1e-3


def test_the_nearer_person_hides_the_farther(view, cast):
    middle = view.camera.center
    nearer = np.array([-30.0, -10.0])
    behind = middle[:2] + 1.03 * (nearer - middle[:2])
    places = [tuple(behind), tuple(nearer), PLACES[2]]
    frame = render_frame(view, cast, cast.pose(people(places)))
    assert frame.visible[1] == 1.0
    # 1.6 m behind, seen from 18 m above: head and shoulders show.
    assert 0.1 < frame.visible[0] < 0.6
    exchanged = render_frame(view, cast, cast.pose(people([places[1], places[0], places[2]])))
    np.testing.assert_array_equal(
        np.where(frame.person_ids == 0, 1, np.where(frame.person_ids == 1, 0, frame.person_ids)),
        exchanged.person_ids,
    )


def test_people_throw_shadows_and_leave_the_rest_alone(view, cast):
    frame = render_frame(view, cast, cast.pose(people(PLACES)))
    nobody = render_frame(view, cast, cast.pose(people([(-30.0, -300.0)] * 3)))
    assert (nobody.person_ids == -1).all()
    assert np.isnan(nobody.boxes).all()
    darker = nobody.image.astype(int).sum(-1) - frame.image.astype(int).sum(-1)
    shadow = (darker > 60) & (frame.person_ids == -1)
    # A person of 35 px throws one of about as many pixels as he fills.
    assert 0.3 < shadow.sum() / (frame.person_ids >= 0).sum() < 3.0
    changed = darker != 0
    assert changed.mean() < 0.1


def test_the_same_arguments_give_the_same_bytes_and_frames_differ_in_noise(cast):
    noisy = open_view(camera(), PITCH, 3, PLAIN.model_copy(update={"noise": 2.0}))
    opened = cast.pose(people(PLACES))
    closed = cast.pose(people(np.array(PLACES) + 0.05))
    one, two = (render_frame(noisy, cast, opened, closed) for _ in range(2))
    assert one.image.tobytes() == two.image.tobytes()
    assert one.person_ids.tobytes() == two.person_ids.tobytes()
    other = render_frame(noisy, cast, opened, closed, frame=1)
    assert one.person_ids.tobytes() == other.person_ids.tobytes()
    assert 0.0 < np.abs(one.image.astype(int) - other.image).mean() < 5.0


def test_missing_people_are_left_out(view, cast):
    poses = people(PLACES)
    transl = poses.transl.copy()
    transl[1] = np.nan
    gone = BodyParameters(poses.betas, poses.global_orient, poses.body_pose, transl)
    frame = render_frame(view, cast, cast.pose(gone))
    assert np.isnan(frame.boxes[1]).all()
    assert frame.visible.tolist() == [1.0, 0.0, 1.0]
    assert set(np.unique(frame.person_ids)) == {-1, 0, 2}


def test_fog_draws_everything_towards_its_grey(cast):
    foggy = open_view(camera(), PITCH, 3, PLAIN.model_copy(update={"fog_per_m": 0.05}))
    frame = render_frame(foggy, cast, cast.pose(people(PLACES)))
    # At 50 m 8 % of the contrast is left.
    spread = frame.image[frame.person_ids >= 0].astype(float).std(axis=0)
    assert spread.max() < 12.0


def test_teams_wear_different_kits_and_everybody_the_same_in_every_order():
    first = dress_people(np.zeros((4, 10)), ["first", "second", "first", "second"], 8)
    middle = first.images[:, 1, 40:60, 60:90].astype(float)
    apart = np.abs(middle[0] - middle[1]).mean()
    assert apart > 40.0
    again = dress_people(np.zeros((2, 10)), ["first", "second"], 8)
    np.testing.assert_array_equal(again.images, first.images[:2])


def test_clusters_share_no_pixel_and_grow_until_they_do_not():
    spans = [(0, 0, 4, 4), (10, 0, 14, 4), None, (3, 3, 8, 8), (7, 0, 11, 9)]
    assert cluster_boxes(spans) == [((0, 0, 14, 9), [0, 1, 3, 4])]
    assert cluster_boxes([(0, 0, 4, 4), (4, 0, 8, 4)]) == [((0, 0, 4, 4), [0]), ((4, 0, 8, 4), [1])]


SMALL = SCENARIOS["tiny"].model_copy(
    update={
        # A third of the usual size: a ninth of the time.
        "rig": SCENARIOS["tiny"].rig.model_copy(
            update={"cameras": 1, "image_size_px": (640, 360), "person_height_px": 40.0}
        ),
        "broadcast": None,
    }
)


def rendered(folder):
    progress = []
    simulate_match(
        SMALL,
        1,
        folder,
        MatchOptions(duration=0.2, render=True, masks=True),
        advance=lambda *each: progress.append(each),
    )
    return progress


@pytest.fixture(scope="module")
def match(tmp_path_factory):
    folder = tmp_path_factory.mktemp("rendered") / "tiny"
    return folder, rendered(folder)


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


def test_the_same_seed_gives_the_same_bytes(match, tmp_path):
    folder, _ = match
    rendered(tmp_path / "again")
    for name in ("videos/cam00.mp4", "stills/cam00.png", "reference/boxes/cam00.npz"):
        assert (folder / name).read_bytes() == (tmp_path / "again" / name).read_bytes()


def test_bystanders_stand_on_the_grass_behind_the_lines():
    pitch = PitchTemplate.standard()
    props = place_bystanders(pitch, 12, 5)
    assert len(props) == 12
    for prop in props:
        vertices = prop.surfaces.vertices[0].astype(float)
        x, y, _ = vertices.mean(axis=0)
        off = max(abs(x) - 52.5, abs(y) - 34.0)
        assert 2.2 < off < 3.6  # a body's middle is some centimetres off its pelvis
        lowest = vertices[vertices[:, 2].argmin()]
        # Level grass under feet of 0.3 m; the crown falls 1 % there.
        assert lowest[2] == pytest.approx(float(pitch.height(x, y)), abs=0.01)
        assert 1.5 < np.ptp(vertices[:, 2]) < 2.0
