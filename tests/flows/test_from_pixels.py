"""Bodies from nothing but pixels: rendered videos through the nets that ship with the project."""

import base64
import re
import shutil

import cv2
import numpy as np
import pytest
import yaml
from command_line import succeed
from page_client import log_in, served

from flows.registering import open_match
from flows.reports.match_pictures import background_image
from flows.results.best_results import Origin
from flows.results.tool_exports import describe_clip
from worldpose import open_run
from worldpose.store.store import Store
from worldpose.video.files import VideoReader


def green_share(image):
    """Return the share of an image's pixels (BGR) that look like grass."""
    blue, green, red = np.moveaxis(image.astype(int), -1, 0)
    return np.mean((green > blue + 20) & (green > red + 20))


def report_images(page):
    for content in re.findall(r"data:image/webp;base64,([A-Za-z0-9+/=]+)", page.read_text()):
        yield cv2.imdecode(np.frombuffer(base64.b64decode(content), np.uint8), cv2.IMREAD_COLOR)


@pytest.mark.slow
def test_a_match_of_videos_alone_is_reported_over_images_of_its_videos(server, tmp_path):
    match, project = tmp_path / "match", tmp_path / "project"
    scenario = ("--scenario", "tiny", "--seed", 2, "--duration", 0.2, "--cameras", 3)
    succeed("simulate", *scenario, "--render", "--out", match)
    shutil.rmtree(match / "stills")
    spec = yaml.safe_load((match / "match.yaml").read_text())
    for camera in spec["cameras"]:
        camera.pop("still", None)
    (match / "match.yaml").write_text(yaml.safe_dump(spec))
    succeed("run", match, "--project", project, "--set", "detection.stride=4")
    store = Store.open(str(project))
    (match_id,) = store.matches()
    assert green_share(background_image(store, open_match(store, match_id), "cam00")) > 0.3
    page = tmp_path / "page.html"
    succeed("report", match, "--project", project, "--out", page)
    # Clicks and people of cameras are drawn over grass; a plot without an image has almost none.
    over_grass = [green_share(image) > 0.15 for image in report_images(page)]
    assert sum(over_grass) >= 5
    origin = Origin(open_run(project, match_id), open_match(store, match_id).registration)
    keypoints = describe_clip(origin, "clip")["keypoints"]
    assert keypoints == "the embedded pose net of this version"
    check_without_videos(match, project, page, f"/api/matches/{match_id}/results/videos/clip")


def check_without_videos(match, project, page, film):
    """Neither a black film nor a refused report: results outlive their videos."""
    ada, videos = log_in(served(project), "Ada"), match / "videos"
    (videos / "cam02.mp4").unlink()
    told = succeed("report", match, "--project", project, "--out", page, "--json")
    assert len(told.json["videos"]) == 1 and "Mean joint error" in page.read_text()
    videos.rename(match / "away")
    answer = ada.get(film)
    assert (answer.status_code, answer.json()["detail"]) == (
        404,
        "no video of this clip is at hand",
    )
    (match / "away").rename(videos)
    page.with_suffix(".mp4").write_bytes(ada.get(film).content)
    with VideoReader(page.with_suffix(".mp4")) as video:
        assert green_share(video.frame(0)[..., ::-1]) > 0.15


@pytest.mark.slow
def test_bodies_come_from_rendered_videos_alone(server, tmp_path):
    match, project = tmp_path / "match", tmp_path / "project"
    scenario = ("--scenario", "tiny", "--seed", 2, "--duration", 0.8, "--cameras", 4)
    succeed("simulate", *scenario, "--render", "--out", match)
    assert not list((match / "detections").iterdir())
    succeed("run", match, "--project", project, "--set", "detection.stride=2")
    truth = ("--prediction", match, "--reference", match / "reference")
    scores = succeed("evaluate", *truth, "--project", project, "--json").json
    assert scores["idf1"] == scores["coverage"] == 1.0
    # 18, 17 and 16 mm were measured; other processors round otherwise, and other weights see else.
    assert scores["mpjpe_mm"] < 40.0
    assert scores["g_mpjpe_mm"] < 40.0
    assert scores["pa_mpjpe_mm"] < 35.0
