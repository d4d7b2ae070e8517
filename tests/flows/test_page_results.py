"""The page of a match shows and downloads the results of a complete run."""

import io
import zipfile

import numpy as np
import pytest
from page_client import MATCH

from data_contracts.release import EXPORT_FORMATS


def test_a_complete_run_gives_its_report_and_its_exports(ada):
    found = ada.get(f"{MATCH}/results").json()
    assert (found["run"], found["formats"]) == ("0001", list(EXPORT_FORMATS))
    assert found["clips"] == [{"id": "clip", "video": None}]  # given keypoints: nothing is filmed
    page = ada.get(f"{MATCH}/results/report")
    assert page.headers["content-type"].startswith("text/html")
    assert "3D view" in page.text
    # Its scripts run without a session: they can neither read nor change anything here.
    policy = page.headers["content-security-policy"]
    assert policy.startswith("sandbox allow-scripts")
    assert "allow-same-origin" not in policy
    assert "default-src 'none'" in policy
    answer = ada.get(f"{MATCH}/results/exports/joints")
    assert "0001-joints.zip" in answer.headers["content-disposition"]
    with zipfile.ZipFile(io.BytesIO(answer.content)) as archive:
        joints = np.load(io.BytesIO(archive.read("joints.npz")))["joints"]
    assert joints.shape[2:] == (17, 3)
    assert np.isfinite(joints).any()
    # Asked again, it is the file that was drawn.
    assert ada.get(f"{MATCH}/results/exports/joints").content == answer.content


@pytest.mark.parametrize("path", ["videos/clip", "videos/other", "exports/fbx"])
def test_what_there_is_none_of_is_said(ada, path):
    assert ada.get(f"{MATCH}/results/{path}").status_code == 404


def test_an_export_that_lacks_a_result_says_what_to_do(ada):
    answer = ada.get(f"{MATCH}/results/exports/slahmr-cameras")
    assert answer.status_code == 422
    assert "expected" in answer.json()["error"]
