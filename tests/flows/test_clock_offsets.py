"""The command `synchronize` proposes clock offsets, draws them, and writes them on request."""

import shutil

import numpy as np
import page_client
import pytest
import yaml
from command_line import succeed
from typer.testing import CliRunner

from data_contracts.match import CameraSpec, ClipSpec, MatchSpec
from flows.cli.app import app
from flows.results.clock_offsets import propose
from flows.run_record import latest_run
from flows.service.inbox import run_key, take_in, watch_once
from flows.service.layout import served_state
from worldpose.errors import UsageError
from worldpose.store.store import Store
from worldpose.triangulation.synchronization import Synchronization


@pytest.fixture(scope="module")
def shifted(tiny, tmp_path_factory):
    """The match `tiny` with a wrong clock offset of one camera."""
    return shift(tiny, tmp_path_factory.mktemp("shifted") / "tiny")


def shift(tiny, folder):
    shutil.copytree(tiny, folder)
    file = folder / "match.yaml"
    content = yaml.safe_load(file.read_text())
    content["cameras"][2]["offset_frames"] = 5
    file.write_text(yaml.safe_dump(content))
    return folder


def test_an_offset_is_found_drawn_and_written(server, shifted, tmp_path):
    options = ("--project", tmp_path / "p", "--json")
    plot = tmp_path / "clocks.svg"
    found = succeed("synchronize", shifted, "--plot", plot, *options).json
    rows = {row["camera"]: row for row in found["cameras"]}
    assert {name: row["proposed"] for name, row in rows.items()} == dict.fromkeys(rows, 0)
    assert rows["cam02"]["stated"] == 5
    assert abs(rows["cam02"]["found"]) < 0.2
    assert found["applied"] == {}
    assert "<svg" in plot.read_text()
    applied = succeed("synchronize", shifted, "--apply", *options).json["applied"]
    assert applied == {"cam02": 0}
    cameras = yaml.safe_load((shifted / "match.yaml").read_text())["cameras"]
    assert [camera.get("offset_frames", 0) for camera in cameras] == [0] * len(cameras)
    assert "match.yaml needs no change" in succeed("synchronize", shifted, *options[:2]).out


def test_the_page_shows_the_same_proposal_and_applies_it_in_the_next_version(
    server, tiny, tmp_path, monkeypatch
):
    project, inbox = tmp_path / "p", tmp_path / "p" / "inbox"
    folder = shift(tiny, tmp_path / "m")
    succeed("run", folder, "--until", "detection", "--project", project)
    before = (folder / "match.yaml").read_bytes()
    inbox.mkdir()
    ada = page_client.log_in(page_client.served(project), "Ada")
    offsets = f"{page_client.MATCH}/offsets"
    found = ada.get(offsets).json()
    assert found["changed"] == {"cam02": 0}
    row = next(each for each in found["cameras"] if each["camera"] == "cam02")
    assert (row["stated"], row["proposed"]) == (5, 0) and abs(row["found"]) < 0.2
    assert ada.get(f"{offsets}/plot").content.startswith(b"\x89PNG")
    with monkeypatch.context() as patch:  # a unit that failed changed nothing
        record = latest_run(Store.open(str(project)), page_client.TINY)
        rest = {unit: key for unit, key in record.results.items() if unit != "detection/cam05"}
        part = record.model_copy(update={"results": rest})
        patch.setattr("flows.web.offsets.latest_run", lambda *_: part)
        assert ada.get(offsets).status_code == 200
    assert ada.post(offsets, json={"offsets": {"cam02": 1}}).status_code == 422  # not the proposal
    assert ada.post(offsets, json={"offsets": found["changed"]}).status_code == 200
    (coming,) = ada.get(page_client.MATCH).json()["next_versions"]
    assert coming["state"] == "arriving"
    store = Store.open(str(project))
    state = served_state(store.url)
    watch_once(state, inbox, 0.0)
    (arrival,) = take_in(store, state, inbox, 0.0, run_key)
    # The same videos are no reason to take an earlier run for that of this version.
    assert arrival.flow_run != f"arrival-{store.registration(page_client.TINY).identity}"
    spec = store.registration(page_client.TINY).spec
    assert [each.offset_frames for each in spec.cameras if each.kind == "static"] == [0] * 6
    assert (folder / "match.yaml").read_bytes() == before
    answer = ada.get(offsets)  # nobody corrects twice by the run of the old offsets
    assert answer.status_code == 422 and "Run it again first" in answer.json()["error"]


@pytest.mark.parametrize(
    ("options", "told"),
    [
        (("--clip", "second"), "--clip second: expected one of clip, found 'second'"),
        (("--plot", "clocks.doc"), "clocks.doc: expected a file name that ends with .svg, .pdf"),
    ],
)
def test_wrong_options_are_told_before_anything_is_computed(shifted, tmp_path, options, told):
    Store.create(tmp_path / "p")
    command = ["synchronize", str(shifted), "--project", str(tmp_path / "p"), *options]
    result = CliRunner().invoke(app, command)
    assert isinstance(result.exception, UsageError)
    assert told in str(result.exception)


@pytest.mark.parametrize(
    ("camera", "first_frame", "late", "proposed"),
    [
        # n(f) = f r + o: ten match frames are 20 frames of a camera with twice the frame rate.
        ({"fps": 100.0, "offset_frames": 20}, 0, -10.0, 40),
        # Of two match frames with one image, the second is a match frame late: 0.5 on average.
        ({"fps": 25.0, "offset_frames": 20}, 0, -10.0 + 0.5, 25),
        ({"offset_frames": ((0, 0.4),)}, 0, -0.4, ((0, 0.4),)),
        # What is stated outside of the clip stays, but for the offset.
        ({"offset_frames": ((740, 2), (741, -3))}, 1000, 1.0, ((740, 1), (741, -4))),
        ({"offset_frames": ((0, 0), (90000, -6))}, 45000, 1.0, ((0, -1.0), (90000, -7.0))),
    ],
)
def test_offsets_are_in_the_cameras_own_frames_for_the_whole_match(
    camera, first_frame, late, proposed
):
    cameras = (
        CameraSpec(id="a", width=9, height=9),
        CameraSpec(id="b", width=9, height=9, **camera),
    )
    clip = ClipSpec(id="clip", first_frame=first_frame, frame_count=30000)
    spec = MatchSpec(match_id="m", fps=50.0, cameras=cameras, clips=(clip,))
    std, empty = np.full(2, 0.05), np.empty(0)
    found = Synchronization(np.array([0.0, late]), std, ("", ""), empty, empty, ((0, 1),))
    row = propose(spec, clip, ["a", "b"], [[(0, 0.0)], [(0, late)]], 1, found)
    np.testing.assert_allclose(row.proposed, proposed, atol=0.02)
