"""Predictions and references by whatever a person names them with."""

from __future__ import annotations

from pathlib import Path

from flows.registering import find_match
from flows.release import clips_of, joint_tracks
from worldpose.errors import UsageError
from worldpose.release import JointTracks, read_joints
from worldpose.store import Store, open_run


def load_prediction(
    name: str, project: str, *, run_id: str = "latest", stage: str | None = None
) -> JointTracks:
    """Joints to be scored: a joints file, a folder that holds one, or a match of the project.

    Raises:
        UsageError: it is none of these, or a match with several clips.
    """
    path = Path(name)
    if path.is_file():
        return read_joints(path)
    if (path / "joints.npz").is_file():
        return read_joints(path / "joints.npz")
    store = Store.open(project)
    match = find_match(store, name)
    run = open_run(project, match.match_id, run_id)
    clips = clips_of(run.record)
    if len(clips) > 1:
        raise UsageError(
            f"--prediction {name}",
            expected="one clip",
            found=f"a match of {len(clips)} clips",
            todo="Export it and score clip by clip.",
        )
    return joint_tracks(run, clips[0], stage)


def load_reference(name: str) -> JointTracks:
    """True joints: a joints file, or a folder that holds `joints.npz`.

    Raises:
        InputError: there is no such file, or it is no joints file.
    """
    path = Path(name)
    return read_joints(path / "joints.npz" if path.is_dir() else path)
