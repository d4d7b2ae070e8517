"""What people are told of matches, without running one."""

import json
import shutil

import pytest
import yaml
from typer.testing import CliRunner

from data_contracts.cameras import CameraCalibration
from data_contracts.match import CameraSpec, ClipSpec, MatchSpec
from flows.cli.app import app
from flows.registering import open_for_review, register
from worldpose.errors import InputError
from worldpose.ingest.calibration_files import write_calibration_toml
from worldpose.store import Store


def made(folder, match_id, pitch=None):
    """A match with two cameras, one of them calibrated, that saw people in frames 0 to 9."""
    spec = MatchSpec(
        match_id=match_id,
        fps=25.0,
        cameras=tuple(CameraSpec(id=f"cam{c}", width=640, height=480) for c in range(2)),
        clips=(ClipSpec(id="clip", frame_count=10),),
        pitch=pitch,
    )
    (folder / "detections").mkdir(parents=True)
    (folder / "match.yaml").write_text(yaml.safe_dump(spec.model_dump(mode="json")))
    for place, camera in enumerate(spec.cameras):
        people = [
            {
                "image_id": frame,
                "category_id": 1,
                "keypoints": [100.0 + place + len(match_id), 100.0, 0.9] * 17,
                "bbox": [90.0, 90.0, 20.0, 20.0],
                "score": 0.9,
            }
            for frame in range(10)
        ]
        (folder / "detections" / f"{camera.id}.json").write_text(json.dumps(people))
    write_calibration_toml(
        folder / "calibration.toml",
        {
            "cam0": CameraCalibration(
                id="cam0",
                image_size=(640, 480),
                focal_px=(600.0, 600.0),
                principal_point_px=(320.0, 240.0),
                distortion=(0.0,) * 5,
                rotation=((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)),
                translation=(0.0, 0.0, 30.0),
            )
        },
    )
    return folder


@pytest.fixture
def store(tmp_path):
    return Store.create(str(tmp_path / "project"))


def said(store, *arguments):
    return CliRunner().invoke(app, [*arguments, "--project", store.url])


def test_an_edit_of_match_yaml_that_the_files_do_not_bear_out_is_refused(store, tmp_path):
    folder = made(tmp_path / "a", "a")
    register(store, folder, unfinished=True)
    content = yaml.safe_load((folder / "match.yaml").read_text())
    content["cameras"][1]["offset_frames"] = 500
    (folder / "match.yaml").write_text(yaml.safe_dump(content))
    with pytest.raises(InputError, match="the camera's offset_frames"):
        open_for_review(store, "a")
    assert store.registration("a").spec.cameras[1].offset_frames == 0
    content["cameras"][1]["offset_frames"] = 2
    (folder / "match.yaml").write_text(yaml.safe_dump(content))
    assert open_for_review(store, "a").folder.spec.cameras[1].offset_frames == 2


def test_a_match_that_cannot_be_read_hides_no_other_review(store, tmp_path):
    for name in ("aa", "b"):
        register(store, made(tmp_path / name, name), unfinished=True)
    shutil.rmtree(tmp_path / "aa")
    answer = said(store, "review", "list")
    assert answer.exit_code == 0
    assert answer.stderr.startswith(f"aa: {tmp_path / 'aa' / 'match.yaml'}")
    assert "nothing waits" in answer.stdout  # though cam1 of b is not clicked yet
    as_json = json.loads(said(store, "review", "list", "--json").stdout)
    assert as_json["reviews"] == [] and list(as_json["problems"]) == ["aa"]
    assert said(store, "review", "list", "aa").exit_code == 1


@pytest.mark.parametrize(
    ("pitch", "told"),
    [
        (None, "to be clicked first: cam1; worldpose review serve shows the pages"),
        (
            "none",
            "no calibration of cam1: add them to calibration.toml (a match without a pitch "
            "cannot be clicked)",
        ),
    ],
)
def test_a_camera_without_calibration_is_sent_where_it_can_get_one(store, tmp_path, pitch, told):
    assert told in said(store, "ingest", str(made(tmp_path / "a", "a", pitch))).stdout


def test_status_cuts_no_id_or_state_and_tells_problems_below(store, tmp_path):
    match_id = "a-match-with-quite-a-long-name-as-leagues-and-seasons-give-them"
    register(store, made(tmp_path / "a", match_id), unfinished=True)
    answer = said(store, "status")
    head, row, problem = answer.stdout.splitlines()[1:]
    assert row.split()[:4] == [match_id, "-", "not", "run"]
    assert head.split()[-1] == "next"
    assert problem.startswith(f"{match_id}: {tmp_path / 'a'}: expected a given calibration")
    assert "worldpose review serve" in problem
