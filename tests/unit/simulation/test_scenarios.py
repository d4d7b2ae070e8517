import numpy as np
import pytest

from worldpose.geometry import Camera, Rigid
from worldpose.ingest import read_match, read_unit
from worldpose.pitch import PitchTemplate
from worldpose.simulation import (
    SCENARIOS,
    MatchOptions,
    ObservationNoise,
    simulate_match,
    simulate_scene,
)
from worldpose.simulation.settings import ActionRates, CrowdSettings

SHORT = 0.4


def short(name, **changes):
    return SCENARIOS[name].model_copy(update={"duration": SHORT, **changes})


@pytest.fixture(scope="module")
def match():
    return simulate_scene(short("match"), 1)


@pytest.fixture(scope="module")
def hard():
    return simulate_scene(short("hard"), 1)


def moving(folder):
    with np.load(folder / "reference" / "cameras" / "clip.npz") as file:
        return {name: file[name] for name in file}


@pytest.mark.parametrize("name", SCENARIOS)
def test_every_scenario_makes_a_match(name, tmp_path):
    scenario = short(name)
    spec = simulate_match(
        scenario, 2, tmp_path / name, MatchOptions(duration=SHORT, cameras=4, stills=False)
    )
    read = read_match(tmp_path / name)
    assert read.spec == spec
    frames = round(SHORT * scenario.fps)
    for camera in spec.static_cameras:
        people, calibration = read_unit(read, camera.id)
        assert (calibration is not None) == (name == "hard")
        assert len(people.frame) == frames
        clicks = read.clicked[camera.id]
        assert len(clicks.points) + len(clicks.drawn) > 1
    if scenario.broadcast is not None:
        people, calibration = read_unit(read, "clip")
        assert calibration is None
        assert len(people.frame) == frames
        assert np.isfinite(people.score).sum(axis=1).mean() > 1.0
        assert {name: array.shape for name, array in moving(tmp_path / name).items()} == {
            "K": (frames, 3, 3),
            "k": (frames, 5),
            "R": (frames, 3, 3),
            "t": (frames, 3),
        }


def test_all_scenarios_but_those_for_static_calibration_have_a_broadcast_clip():
    without = [name for name, each in SCENARIOS.items() if each.broadcast is None]
    assert without == ["sparse-corner"]


@pytest.mark.parametrize("seed", range(4))
def test_cameras_of_sparse_corner_see_one_or_two_corners_and_lines(seed):
    scene = simulate_scene(short("sparse-corner", crowd=CrowdSettings(people=0)), seed)
    pitch = PitchTemplate.standard()
    for name, camera in scene.cameras.items():
        pixels = camera.project(pitch.positions(list(pitch.points)))
        inside = ((pixels > 0.0) & (pixels < [1919.0, 1079.0])).all(axis=-1)
        assert 1 <= inside.sum() <= 2
        assert len(scene.clicks[name].markings.drawn) >= 3


@pytest.mark.parametrize("seed", range(3))
def test_one_in_five_cameras_of_the_match_has_one_wrong_click(seed):
    scene = simulate_scene(short("match", duration=0.04, broadcast=None), seed)
    wrong = [len(clicks.wrong) for clicks in scene.clicks.values()]
    assert all(sum(wrong[first : first + 5]) == 1 for first in range(len(wrong) - 4))
    for clicks in scene.clicks.values():
        assert 8 <= len(clicks.markings.points) <= 12


def test_the_same_seed_gives_the_same_bytes_with_everything_switched_on(tmp_path):
    contents = []
    for name in ("a", "b"):
        simulate_match(short("hard"), 3, tmp_path / name, MatchOptions(cameras=3, stills=False))
        contents.append(
            {
                path.relative_to(tmp_path / name).as_posix(): path.read_bytes()
                for path in sorted((tmp_path / name).rglob("*"))
                if path.is_file()
            }
        )
    assert contents[0] == contents[1]


def test_the_match_has_two_teams_officials_and_16_cameras(match):
    assert match.truth.joints.shape == (20, 25, 17, 3)
    assert len(match.cameras) == 16
    assert set(match.observations) == {*match.cameras, "clip"}
    # Every joint is seen by several: at least four cameras see every place.
    assert (match.truth.views >= 3).mean() > 0.95
    assert match.given == match.cameras
    assert set(match.clocks.values()) == {0.0}


def test_the_moving_camera_is_written_as_it_filmed(tmp_path):
    scenario = short("broadcast-zoom", noise=ObservationNoise.none())
    simulate_match(scenario, 1, tmp_path / "m", MatchOptions(cameras=1, stills=False))
    scene = simulate_scene(
        scenario.model_copy(update={"rig": scenario.rig.model_copy(update={"cameras": 1})}), 1
    )
    camera = moving(tmp_path / "m")
    identity = scene.identities["clip"].person
    people, _ = read_unit(read_match(tmp_path / "m"), "clip")
    for frame in (0, 7, 19):
        one = Camera(
            focal=np.diag(camera["K"][frame])[:2],
            principal_point=camera["K"][frame, :2, 2],
            distortion=camera["k"][frame],
            cam_from_world=Rigid(camera["R"][frame], camera["t"][frame]),
            image_size=np.array([1920, 1080]),
        )
        places = np.flatnonzero(identity[frame] >= 0)
        assert len(places) > 1
        for place in places:
            expected = one.project(scene.truth.joints[frame, identity[frame, place]])
            found = np.isfinite(people.keypoints[frame, place, :, 0])
            # float32 holds pixels below 2048 to 6e-5; the file holds the camera exactly.
            np.testing.assert_allclose(
                people.keypoints[frame, place, found], expected[found], atol=6.2e-5, rtol=0
            )


def test_a_late_clock_sees_people_where_they_are_later():
    rig = SCENARIOS["match"].rig.model_copy(update={"cameras": 2, "clock_std_frames": 0.7})
    scenario = short("match", rig=rig, noise=ObservationNoise.none(), broadcast=None)
    scene = simulate_scene(scenario, 5)
    off = {}
    for name, camera in scene.cameras.items():
        identity = scene.identities[name].person
        at = np.stack(np.nonzero(identity[1:-1] >= 0), axis=-1) + np.array([1, 0])
        late = scene.clocks[name]
        errors = []
        for frame, place in at:
            joints = scene.truth.joints[:, identity[frame, place], 11]
            neighbour = joints[frame + (1 if late > 0 else -1)]
            then = joints[frame] + (neighbour - joints[frame]) * abs(late)
            errors.append(
                np.abs(
                    camera.project(then[None])
                    - scene.observations[name].keypoints[frame, place, 11]
                )
            )
        off[name] = np.nanmax(errors)
    assert all(0.0 < abs(late) < 1.0 for late in scene.clocks.values())
    # A hip that accelerates at 50 m/s^2 leaves the chord between two frames by 2.5 mm: 0.2 px.
    assert max(off.values()) < 0.4


def test_the_hard_match_is_hard_in_every_way(hard):
    assert len({round(late, 6) for late in hard.clocks.values()}) == 16
    assert np.std(list(hard.clocks.values())) == pytest.approx(0.5, rel=0.5)  # 16 draws
    found = np.concatenate(
        [np.isfinite(each.confidence).ravel() for each in hard.observations.values()]
    )
    thrown = np.concatenate([each.displaced.ravel() for each in hard.identities.values()])
    # Some 60000 joints: standard error 0.1 %.
    assert thrown.sum() / found.sum() == pytest.approx(0.08, abs=0.01)
    errors = [
        np.linalg.norm(hard.given[name].center - camera.center)
        for name, camera in hard.cameras.items()
    ]
    assert np.median(errors) < 0.3
    assert sum(error > 0.5 for error in errors) == 1


def test_nothing_of_the_truth_is_where_the_factory_looks(tmp_path):
    simulate_match(short("hard"), 1, tmp_path / "m", MatchOptions(cameras=3, stills=False))
    for file in (tmp_path / "m" / "detections").iterdir():
        with np.load(file) as content:
            assert set(content) == {"frame", "keypoints", "confidence", "boxes", "score"}
    assert {camera.offset_frames for camera in read_match(tmp_path / "m").spec.cameras} == {0.0}


def test_people_touch_in_the_penalty_box():
    scene = simulate_scene(SCENARIOS["penalty-box"], 1)
    middle = scene.truth.joints[:, :, 11:13, :2].mean(axis=2)
    apart = np.linalg.norm(middle[:, :, None] - middle[:, None], axis=-1)
    apart[:, np.arange(6), np.arange(6)] = np.inf
    assert apart.min() < 1.5
    assert (np.abs(middle[..., 0]) > 33.0).all()  # the box begins 36 m from the halfway line
    assert (scene.truth.views < 10).mean() > 0.1  # occluded by a person, or outside the image


def test_all_bias_and_no_noise_is_the_same_in_all_frames_for_who_stands():
    noise = ObservationNoise.none().model_copy(update={"shared_bias_m": 0.03})
    crowd = SCENARIOS["tiny"].crowd.model_copy(
        update={"speed_m_s": (0.0, 0.0), "people": 1, "actions": ActionRates.none()}
    )
    scene = simulate_scene(short("tiny", noise=noise, crowd=crowd), 1)
    steady = scene.observations["cam00"].keypoints[:, 0, 5:]
    # float32 pixels.
    assert np.ptp(steady, axis=0).max() < 2e-4
    truth = scene.cameras["cam00"].project(scene.truth.joints[0, 0, 5:])
    assert 0.5 < np.abs(steady[0] - truth).max() < 12.0  # 3 cm at 64 px per metre and 3 sigma
    # It is the detector's definition of joints, the same for all views.
    for name, camera in scene.cameras.items():
        taken = camera.project(scene.defined[0, 0, 5:])
        seen = scene.observations[name].keypoints[0, 0, 5:]
        np.testing.assert_allclose(seen, taken, atol=1e-3)
