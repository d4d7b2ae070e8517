"""A run by the paper's method, with a body file of the user, on a match without truth."""

import json
import shutil

import numpy as np
import pytest
from command_line import TINY, succeed

from worldpose import open_run
from worldpose.body.body_file import load_open_body

torch = pytest.importorskip("torch")
pytestmark = pytest.mark.usefixtures("server")

STAGES = ("static_calibration", "triangulation", "bundle_adjustment", "body_fitting")


@pytest.fixture
def smpl_file(tmp_path):
    """The open body with made-up pose correctives, under SMPL's keys."""
    body, rng = load_open_body(), np.random.default_rng(5)
    parents = np.where(body.parents < 0, 2**32 - 1, body.parents)
    arrays = {
        "v_template": body.template,
        "shapedirs": body.shape_directions,
        "posedirs": 0.002 * rng.normal(size=(6890, 3, 207)),
        "J_regressor": body.joint_regressor,
        "weights": body.weights,
        "kintree_table": np.stack([parents, np.arange(24)]),
        "f": body.faces,
    }
    np.savez(tmp_path / "SMPL_NEUTRAL.npz", **arrays)
    return tmp_path / "SMPL_NEUTRAL.npz", arrays


@pytest.mark.slow  # unit/reference_method has its stages
@pytest.mark.timeout(900)
def test_the_paper_s_method_fits_an_installed_body_whose_joints_are_those_of_smplx(
    tiny, tmp_path, smpl_file
):
    file, arrays = smpl_file
    match, project, out = tmp_path / "match", tmp_path / "project", tmp_path / "out"
    shutil.copytree(tiny, match)
    shutil.rmtree(match / "reference")
    bodies = ("--body-folder", tmp_path / "bodies")
    succeed("body", "install", file, *bodies)
    methods = [text for stage in STAGES for text in ("--set", f"{stage}.method=paper")]
    body = ("--set", "body_fitting.body_model=smpl-neutral")
    told = succeed("run", match, "--project", project, *methods, *body, *bodies, "--json").json
    assert told["failed"] == 0
    run = open_run(project, TINY)
    adjusted = run["bundle_adjustment/cameras"]
    assert adjusted["accepted"].values.all()
    assert "no validation" in adjusted.attrs["reasons"][0]
    # Other commands take the folder from the run.
    succeed("report", TINY, "--project", project, "--out", tmp_path / "report.html")
    succeed("export", TINY, "--project", project, "--format", "worldpose", "--out", out)
    scores = succeed(
        "evaluate", "--prediction", TINY, "--project", project, "--reference", tiny / "reference",
        "--json",
    )  # fmt: skip
    assert json.loads(scores.out)["g_mpjpe_mm"] < 120.0
    smplx = pytest.importorskip("smplx")
    from smplx.utils import Struct

    arrays["kintree_table"][0, 0] = 0
    with np.load(out / "poses/clip.npz") as poses:
        person, frames = 0, poses["transl"].shape[1]
        names = ("global_orient", "body_pose", "transl")
        given = {name: torch.tensor(poses[name][person]) for name in names}
        given["betas"] = torch.tensor(poses["betas"][[person]]).expand(frames, -1)
    layer = smplx.SMPL("", data_struct=Struct(**arrays), batch_size=frames, dtype=torch.float64)
    with torch.no_grad():
        theirs = layer(**{n: each.to(torch.float64) for n, each in given.items()}).joints.numpy()
    ours = run["body_fitting/clip"]["joints"].values[:, person]
    # Shoulders to ankles of COCO-17 are joints of SMPL; 0.01 mm.
    smpl = [16, 17, 18, 19, 20, 21, 1, 2, 4, 5, 7, 8]
    known = np.isfinite(ours[:, 5, 0])
    assert known.any()
    np.testing.assert_allclose(ours[known, 5:], theirs[known][:, smpl], atol=1e-5)
