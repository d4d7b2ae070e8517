"""A challenge's inputs become matches, and their runs become a submission with its score."""

import shutil

import numpy as np
import pytest
from command_line import succeed, worldpose
from simulated_kit import lay_out_kit

from worldpose.formats.challenge import read_submission, write_submission

NAME = "TEAM_OTHER_000003"


def make_kit(folder, seconds):
    made = ("--scenario", "tiny-broadcast", "--seed", 3, "--duration", seconds, "--no-stills")
    succeed("simulate", *made, "--out", folder / "simulated")
    lay_out_kit(folder / "simulated", folder / "kit", NAME)
    return folder / "kit"


@pytest.fixture(scope="module")
def kit(tmp_path_factory):
    """A kit of five frames; read only."""
    return make_kit(tmp_path_factory.mktemp("challenge"), 0.2)


@pytest.mark.slow  # unit/formats has the files, test_release_formats what is written
def test_the_kit_becomes_a_scored_submission_with_the_given_rows(server, tmp_path):
    inputs = make_kit(tmp_path, 1)
    (inputs / "videos" / f"{NAME}.mp4").rename(inputs / "videos" / f"{NAME}.MP4")
    (inputs / "true.zip").rename(tmp_path / "true.zip")
    # Rows in another order, so that a tracker's own numbers would not do.
    order = [3, 0, 4, 1, 2]
    for kind in ("boxes", "skel_2d", "skel_3d"):
        file = inputs / kind / f"{NAME}.npy"
        np.save(file, np.load(file)[:, order])
    truth = read_submission(tmp_path / "true.zip")[NAME][order]
    write_submission(tmp_path / "true.parquet", {NAME: truth})
    succeed("import", "--challenge", inputs, "--out", tmp_path / "matches")
    match = tmp_path / "matches" / NAME
    assert not (match / "reference").exists()
    project = ("--project", tmp_path / "project")
    succeed("run", match, *project)
    succeed("export", NAME, *project, "--format", "challenge", "--out", tmp_path / "out")
    submission = tmp_path / "out/submission.zip"
    assert read_submission(submission)[NAME].shape == truth.shape
    scored = ("--prediction", submission, "--reference", tmp_path / "true.parquet", "--json")
    scores = succeed("evaluate", *scored).json
    assert scores["challenge_global_m"] < 0.25
    assert scores["challenge_score"] < 0.8


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda kit: (kit / "boxes" / f"{NAME}.npy").unlink(), ("boxes", NAME)),
        (lambda kit: shutil.copy(kit / f"boxes/{NAME}.npy", kit / "boxes/B.npy"), ("B.npz",)),
        (
            lambda kit: shutil.copy(kit / f"videos/{NAME}.mp4", kit / f"videos/{NAME}.mov"),
            (f"one video of {NAME}", f"{NAME}.mov"),
        ),
        (lambda kit: (kit / "pitch_points.txt").unlink(), ("pitch_points.txt",)),
        (lambda kit: shutil.rmtree(kit / "videos"), (f"videos/{NAME}.mp4", "neither")),
        (lambda kit: cut(kit, "boxes"), ("skel_2d", "(4, 5)", "(5, 5")),
        (lambda kit: cut(kit, "skel_3d"), ("skel_3d", "(5, 5)", "(4, 5")),
        (lambda kit: change_camera(kit, "K", (2, 0, 1), 3.0), ("K[2]", "without skew")),
        (lambda kit: change_camera(kit, "R", (0, 0, 0), np.nan), ("R[0]", "first frame")),
        (lambda kit: change_camera(kit, "k", (2, 4), 0.1), ("k[2]", "three zeros")),
    ],
)
def test_a_wrong_kit_is_refused_with_the_file_and_what_is_expected(kit, tmp_path, change, words):
    inputs = shutil.copytree(kit, tmp_path / "kit")
    change(inputs)
    answer = worldpose("import", "--challenge", inputs, "--out", tmp_path / "matches")
    assert answer.code == 1, answer.err
    assert all(word in answer.err for word in words), answer.err
    assert not (tmp_path / "matches").exists()


def cut(kit, kind):
    file = kit / kind / f"{NAME}.npy"
    np.save(file, np.load(file)[:-1])


def change_camera(kit, key, at, value):
    file = kit / "cameras" / f"{NAME}.npz"
    arrays = dict(np.load(file))
    arrays[key][at] = value
    np.savez(file, **arrays)
