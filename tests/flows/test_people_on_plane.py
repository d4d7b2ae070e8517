"""A match of one camera: no person is triangulated, and every person has a pitch position."""

import csv
from datetime import UTC, datetime
from types import SimpleNamespace
from unittest.mock import patch

import numpy as np
import page_client
from command_line import succeed, worldpose
from test_broadcast_run import errors_of

import worldpose as library
from flows.match import IncompleteRunError
from flows.registering import open_for_review
from flows.web.app_context import Continuing
from flows.web.evidence import draw_evidence
from worldpose.formats.viewer_file import decode_part, read_viewer
from worldpose.store.store import Store
from worldpose.video.files import write_video


def check_pages(folder, match):
    """The pages reach the positions of the run, and say why there is no 3D."""
    project = folder / "worldpose-data"
    ada, path = page_client.log_in(page_client.served(project), "Ada"), f"/api/matches/{match}"
    found = ada.get(f"{path}/results").json()
    assert (found["state"], found["later"]) == ("partial", "")
    assert set(found["formats"]) == {"positions", "minimap", "csv", "parquet", "viewer"}
    for form in found["formats"]:
        assert ada.get(f"{path}/results/exports/{form}").status_code == 200, form
    assert ada.get(f"{path}/results/report").status_code == 200
    (clip,) = found["clips"]
    assert "one camera alone shows people" in clip["without_joints"]
    assert "people are placed on the pitch from their feet" in clip["without_joints"]
    # A person without joints is seen, too: the image is where the detection is.
    person, *_ = ada.get(f"{path}/identities/clip").json()["people"]
    assert any(person["way"])  # from above, the person is where the feet are
    crop = {"person": person["id"], "frame": person["segments"][0][0]}
    answer = ada.get(f"{path}/identities/clip/crop", params=crop)
    assert (answer.status_code, answer.headers["content-type"]) == (200, "image/png"), answer.text

    # A question about the tracks shows the paths of the feet.
    store = Store.open(str(project))
    keys = {"tracking/clip": store.run(match).results["tracking/clip"]}
    asked = SimpleNamespace(gate="tracking", match_id=match, keys=keys)
    with patch("flows.web.evidence.plot_paths") as plot:
        draw_evidence(store, open_for_review(store, match), asked)
    assert np.isfinite(plot.call_args[0][0].joints).all(axis=-1).any(axis=(0, 2)).sum() >= 10


def test_the_end_of_a_partial_run_says_what_is_missing(project_copy, monkeypatch):
    store = Store.open(str(project_copy))
    (match,) = store.matches()
    why = "one camera alone shows people"
    changed = {"run_id": store.reserve_run(match), "state": "partial", "warnings": (why,)}
    record = store.run(match).model_copy(update=changed)
    store.finish_run(record)
    text = str(IncompleteRunError(record))
    assert why in text
    assert "0 " not in text
    last = SimpleNamespace(state="failed", message=text, changed_at=datetime.now(UTC))
    served = SimpleNamespace(link=lambda run: "http://prefect")
    seen = SimpleNamespace(open=[], ended={match: last}, served=served)
    monkeypatch.setattr(Continuing, "_look", lambda self: seen)
    state = Continuing(store).state(match)
    assert (state["code"], state["lines"]) == (4, [text])


def test_one_camera_gives_positions_on_the_pitch_with_their_uncertainty(server, tmp_path):
    one = ("--scenario", "match", "--seed", 5, "--duration", 1, "--no-stills", "--cameras", 1)
    succeed("simulate", *one, "--out", tmp_path / "one")
    (tmp_path / "one/videos").mkdir()
    grey = (np.full((1080, 1920, 3), 90, np.uint8) for _ in range(50))
    write_video(tmp_path / "one/videos/cam00.mp4", grey, 50.0)
    project = ("--project", tmp_path / "worldpose-data")
    answer = worldpose("run", tmp_path / "one", *project)
    assert answer.code == 4, answer.err
    assert "one camera alone shows people" in answer.err
    assert "people are placed on the pitch from their feet" in answer.err
    assert "placed no joint" not in answer.err
    match = library.read_match(tmp_path / "one").spec.match_id
    succeed("export", match, *project, "--format", "positions", "--out", tmp_path / "out")
    with (tmp_path / "out/positions/clip.csv").open() as file:
        rows = list(csv.DictReader(file))
    view = tmp_path / "view.html"
    succeed("export", match, *project, "--format", "viewer", "--out", view)
    (parts,) = read_viewer(view)
    scene, _ = decode_part(parts["scene"])
    header, arrays = decode_part(parts["0"])
    assert {person["kind"] for person in scene["people"]} == {"plane"}
    shown = [scene["people"][column]["id"] for column in header["plane"]]
    for row in rows:
        at = int(row["frame"]) - scene["first"], shown.index(int(row["person"]))
        assert (
            np.abs(arrays["ground"][at][:2] - [float(row["x_m"]), float(row["y_m"])]).max() < 1e-3
        )
    page = tmp_path / "report.html"
    succeed("report", match, "--out", page, "--no-videos", *project)
    assert page.read_text().count("<td>plane</td>") == len({row["person"] for row in rows})
    tiles = page.read_text()
    assert f"{len(shown)}</b>" in tiles
    assert "people on the pitch, 0 with joints" in tiles
    assert "<b>0 m</b>" not in tiles
    refused = worldpose("export", match, *project, "--format", "trc", "--out", tmp_path / "trc")
    assert refused.code == 1
    assert "expected a person with joints" in refused.err
    check_pages(tmp_path, match)
    errors, inside, people = errors_of(tmp_path / "out/positions/clip.csv", tmp_path / "one")
    assert people >= 10
    assert np.median(errors) < 0.3
    assert inside > 0.9
    heights = [float(row["height_m"]) for row in rows]
    assert 1.6 < np.median(heights) < 2.0
