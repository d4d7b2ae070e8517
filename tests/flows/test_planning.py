"""Planning a long match: what deciding what to run costs, and what it looks at once."""

import cProfile
import pstats
from types import SimpleNamespace

import pytest

from data_contracts.broadcast_calibration import KeyFrame, KeyFrames
from data_contracts.match import CameraSpec, ClipSpec, MatchSpec, Registration, SourceFile
from data_contracts.static_calibration import ClickedMarkings
from flows.method import METHOD
from flows.run_plan import RunPlan
from flows.stage import Match
from worldpose.ingest.match_folder import MatchFolder
from worldpose.review.journal import Journal

CAMERAS = 6


class Everything:
    """A store that has every result."""

    def has(self, *place):
        return True

    def manifest(self, *place):
        return SimpleNamespace(left_out={})


@pytest.fixture
def filmed(tmp_path):
    """A function that makes a match of so many clips, all of whose people are in videos."""

    def match(count):
        static = [CameraSpec(id=f"cam{k:02d}", width=1920, height=1080) for k in range(CAMERAS)]
        main = CameraSpec(id="main", kind="broadcast", width=1920, height=1080)
        clips = [
            ClipSpec(id=f"clip{k:03d}", first_frame=k * 900, frame_count=900, broadcast="main")
            for k in range(count)
        ]
        spec = MatchSpec(match_id="long", fps=50, cameras=(*static, main), clips=clips)
        names = [camera.id for camera in static] + [clip.id for clip in clips]
        videos = {name: tmp_path / f"{name}.mp4" for name in names}
        files = [
            SourceFile(path=f"{name}.mp4", size=1, modified_ns=1, sha256=f"{k:064x}")
            for k, name in enumerate(videos)
        ]
        nothing = ClickedMarkings(points=())
        key_frames = KeyFrames(key_frames=(KeyFrame(frame=0, markings=nothing),))
        folder = MatchFolder(
            folder=tmp_path,
            spec=spec,
            calibrations={},
            detections={},
            pitch=None,
            videos=videos,
            clicked={camera.id: nothing for camera in static},
            stills={},
            key_frames={clip.id: key_frames for clip in clips},
        )
        known = {"folder": str(tmp_path), "identity": "b" * 64, "files": files}
        return Match(folder, Registration(spec=spec, **known), Journal("long"))

    return match


def calls(match):
    """Calls of functions that planning two iterations takes, and the units that it finds."""
    profile = cProfile.Profile()
    units, before = 0, None
    for _ in range(2):
        plan = RunPlan(Everything(), match, {}, before=before)
        for stage in METHOD:
            plan.add_results(profile.runcall(plan.plan_stage, stage))
            assert not plan.blocked
        units, before = units + len(plan.results), plan.results
    return pstats.Stats(profile).total_calls, units


def test_planning_takes_as_much_a_unit_of_a_long_match_as_of_a_short_one(filmed):
    calls(filmed(1))  # what is found out once a process
    short, few = calls(filmed(10))
    long, many = calls(filmed(40))
    assert many > 3.5 * few
    assert long / many < 1.2 * short / few


def test_a_folders_digest_is_of_the_names_and_contents_below_it():
    def files(**contents):
        paths = {name.replace("_", "/") + ".png": digit * 64 for name, digit in contents.items()}
        listed = [
            SourceFile(path=path, size=1, modified_ns=1, sha256=digest)
            for path, digest in paths.items()
        ]
        camera = CameraSpec(id="cam00", width=1920, height=1080)
        clip = ClipSpec(id="clip", first_frame=0, frame_count=2)
        spec = MatchSpec(match_id="m", fps=50, cameras=[camera], clips=[clip])
        return Registration(spec=spec, folder="m", identity="b" * 64, files=listed)

    first = files(videos_cam00_1="1", videos_cam00_2="2", videos_cam01_1="1")
    assert first.digest_of("videos/cam00/1.png") == "1" * 64
    assert first.digest_of("videos/cam0") is None
    assert first.digest_of("videos/cam00") != first.digest_of("videos/cam01")
    for other in (
        files(videos_cam00_1="1", videos_cam00_3="2"),
        files(videos_cam00_1="1", videos_cam00_2="3"),
        files(videos_cam00_1="1"),
    ):
        assert other.digest_of("videos/cam00") != first.digest_of("videos/cam00")
    moved = files(videos_cam01_1="1", videos_cam01_2="2")
    assert moved.digest_of("videos/cam01") == first.digest_of("videos/cam00")
