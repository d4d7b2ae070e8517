"""One data set of the runs of several matches, and the check of all that it states."""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Final, Literal

import numpy as np

from data_contracts.arrays import Floats
from data_contracts.conventions import COCO17
from data_contracts.release import (
    CheckReport,
    ClipFigures,
    ClipStatistics,
    DataSetManifest,
    Finding,
    ReleasedSequence,
    ReleasedVideo,
    Split,
)
from data_contracts.run import StoredFile
from flows.results.best_results import Origin, filmed_cameras, fitted_bodies, tracked_people
from flows.results.dataset import check, count
from flows.results.export import keep_run
from worldpose.body.body_file import find_body
from worldpose.body.keypoints import fold_keypoints
from worldpose.body.occlusions import visible_shares
from worldpose.dataset.manifest import (
    DATA_SET,
    changed_files,
    read_data_set,
    released_files,
    write_frame_rates,
    write_manifest,
)
from worldpose.dataset.statistics import data_set_statistics
from worldpose.errors import InputError, UsageError
from worldpose.formats.archives import write_archive, wrong
from worldpose.formats.challenge import (
    challenge_truth,
    read_boxes,
    read_camera,
    read_camera_rows,
    write_challenge_camera,
    write_moving_camera,
)
from worldpose.formats.files import read_yaml
from worldpose.formats.joints_file import read_joints, read_poses, write_joints, write_poses
from worldpose.ingest.footage import unit_frames
from worldpose.ingest.match_folder import read_match
from worldpose.ingest.pitch_file import NO_PITCH
from worldpose.store.store import Store

ASSETS: Final = ("poses", "joints", "cameras", "boxes", "footage")
"""Kinds of files, each with a licence."""
FootageForm = Literal["none", "digest", "copy"]


@dataclass(frozen=True)
class ReleaseOptions:
    """What a data set is called, holds and hides."""

    name: str
    licences: Mapping[str, str]
    """Text by kind of file."""
    hidden: Path | None = None
    """New folder of the test part's truth; None without a test part."""
    footage: FootageForm = "none"
    subjects: Path | None = None
    """YAML file of subjects: a list of MATCH/NAME or MATCH/CLIP/ID for each."""


def write_data_set(
    store: Store, origins: Sequence[tuple[Origin, Split]], out: Path, options: ReleaseOptions
) -> DataSetManifest:
    """Write a new folder with all clips of several runs, and release.json; pin the runs.

    `train` and `val` have poses, joints, cameras and boxes; `test` has boxes, and cameras with the
    pose of the first frame alone: the rest is in the hidden folder.

    Raises:
        UsageError: a folder exists, the test part has no hidden folder, or a licence is missing.
        InputError: a result or video is missing, or a subject is in two splits.
    """
    hidden = options.hidden
    tested = any(split == "test" for _, split in origins)
    if tested != (hidden is not None) or (hidden and out.resolve() in hidden.resolve().parents):
        todo = "Name both --test MATCH and --hidden FOLDER, a folder that you do not publish."
        raise _refuse("--hidden", "a folder for the test part's truth, not in --out", hidden, todo)
    for place in (out, hidden or out):
        if place.exists():
            raise _refuse(f"{place}", "a new folder", "one that exists", "Choose another folder.")
    needed = ASSETS[:-1] if options.footage == "none" else ASSETS
    for asset in needed:
        if not options.licences.get(asset, "").strip():
            todo = f"Add --licence {asset}=FILE, or --licence FILE for all but footage."
            raise _refuse("--licence", f"the licence of {asset}", "none", todo)
    out.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix=f".{out.name}.", dir=out.parent) as workshop:
        draft, truth = Path(workshop) / "public", Path(workshop) / "hidden"
        clips: dict[str, ReleasedSequence] = {}
        for origin, split in origins:
            for clip in origin.clips:
                name = f"{origin.spec.match_id}_{clip}".replace(".", "_")
                if name in clips:
                    todo = "Name each match once, and rename clips whose names differ by dots."
                    raise _refuse(name, "one clip of this name", "two", todo)
                part = truth if split == "test" else draft / split
                clips[name] = _write_clip(origin, clip, name, split, part, draft / split, options)
        clips = _name_subjects(clips, options.subjects)
        parts = [part for part in (draft / "train", draft / "val", truth) if part.is_dir()]
        counted = {name: each for part in parts for name, each in count([part]).clips.items()}
        manifest = DataSetManifest(
            release=options.name,
            worldpose=version("worldpose"),
            pitch=all(origin.spec.pitch != NO_PITCH for origin, _ in origins),
            licences={asset: options.licences[asset] for asset in needed},
            clips=clips,
            statistics=data_set_statistics(counted, len(_splits_of(clips))),
            files=(),
            hidden=_listed(truth),
        )
        from worldpose.reports.data_set import data_set_page  # late: it loads matplotlib, 0.5 s

        checks = {part.name: check(part, pitch=manifest.pitch) for part in parts}
        page = data_set_page(options.name, manifest.statistics, checks, manifest)
        (draft / "datasheet.html").write_text(page, encoding="utf-8")
        manifest = manifest.model_copy(update={"files": _listed(draft)})
        write_manifest(draft, manifest)
        for origin, _ in origins:
            keep_run(store, origin, options.name)
        if hidden is not None:
            hidden.parent.mkdir(parents=True, exist_ok=True)
            shutil.move(truth, hidden)
        draft.replace(out)
    return manifest


def _refuse(where: str, expected: str, found: object, todo: str) -> UsageError:
    return UsageError(where, expected=expected, found=f"{found}", todo=todo)


def _listed(folder: Path) -> tuple[StoredFile, ...]:
    return released_files(folder, [path for path in folder.rglob("*") if path.is_file()])


def _write_clip(
    origin: Origin,
    clip: str,
    name: str,
    split: Split,
    part: Path,
    public: Path,
    options: ReleaseOptions,
) -> ReleasedSequence:
    """Write the files of one clip: its truth to `part`, of a test part the rest to `public`."""
    model, poses, people = fitted_bodies(origin.run, clip)
    tracks, spec = origin.tracks(clip), origin.spec
    write_poses(part / "poses" / f"{name}.npz", poses, model.name)
    write_joints(part / f"{name}.joints.npz", tracks)
    write_frame_rates(part, {name: spec.fps})
    views, footage = {}, {}
    for view, camera in filmed_cameras(origin.run, clip).items():
        label = name + view.removeprefix(clip)
        width, height = (int(side) for side in camera.image_size.reshape(-1, 2)[0])
        views[label] = width, height
        write_moving_camera(part / "cameras" / f"{label}.npz", camera)
        boxes = project_people(part, name, label, views[label])
        write_archive(part / "boxes" / f"{label}.npz", boxes)
        if split == "test":
            write_challenge_camera(public / "cameras" / f"{label}.npz", camera, 2026)
            write_archive(public / "boxes" / f"{label}.npz", boxes)
        if options.footage != "none":
            footage[label] = _write_footage(origin, view, public / "footage" / label, options)
    found = {person: track.name for person, track in tracked_people(origin.run, clip)[1].items()}
    names = [found.get(person) or f"{clip}/{person}" for person in people.tolist()]
    return ReleasedSequence(
        split=split,
        match_id=spec.match_id,
        run_id=origin.run.record.run_id,
        clip_id=clip,
        first_frame=int(tracks.frames[0]),
        fps=spec.fps,
        body_model=model.name,
        subjects=tuple(f"{spec.match_id}/{each}" for each in names),
        views=views,
        footage=footage,
    )


def _write_footage(origin: Origin, view: str, out: Path, options: ReleaseOptions) -> ReleasedVideo:
    folder, spec = Path(origin.registration.folder), origin.spec
    video = read_match(folder).videos.get(view)
    source = "" if video is None else video.relative_to(folder).as_posix()
    digest = origin.registration.digest_of(source)
    if video is None or digest is None:
        todo = "Add it to the match folder and run again, or choose --footage none."
        raise wrong(f"{folder}: {view}", "its video", "none", todo)
    copied = out.with_name(f"{out.name}{video.suffix}")
    if options.footage == "copy":
        copied.parent.mkdir(parents=True, exist_ok=True)
        (shutil.copytree if video.is_dir() else shutil.copyfile)(video, copied)
    return ReleasedVideo(
        path="/".join(copied.parts[-3:]) if options.footage == "copy" else None,
        source=source,
        sha256=digest,
        first_image=unit_frames(spec, view).number(spec.clips_of(view)[0].first_frame),
    )


def project_people(part: Path, clip: str, view: str, size: tuple[int, int]) -> dict[str, Floats]:
    """Return boxes (frames, persons, 4) [px] and visibility (frames, persons) of a clip's files.

    Boxes are around the surfaces of bodies, within the image; NaN outside. Visibility is the share
    of joints in the image that no nearer person hides. The image has width and height `size` [px].
    """
    poses, model = read_poses(part / "poses" / f"{clip}.npz")
    camera = read_camera(part / "cameras" / f"{view}.npz", size)
    joints = read_joints(part / f"{clip}.joints.npz").joints
    truth = challenge_truth(find_body(model or ""), poses, camera)
    boxes = np.full((*joints.shape[:2], 4), np.nan)
    boxes[:, truth.persons] = truth.clip.boxes
    return {"boxes": boxes, "visibility": visible_shares(joints, camera)}


def _name_subjects(
    clips: Mapping[str, ReleasedSequence], file: Path | None
) -> dict[str, ReleasedSequence]:
    """Return the clips with the subjects of a registry.

    Raises:
        InputError: the registry has another form or unknown people, or puts one into two splits.
    """
    registry = {} if file is None else read_yaml(file)
    known = {person for clip in clips.values() for person in clip.subjects}
    owner: dict[str, str] = {}
    for subject, people in registry.items() if isinstance(registry, dict) else [("", None)]:
        for person in people if isinstance(people, list) else [people]:
            if person not in known or person in owner:
                expected = "a list of MATCH/NAME or MATCH/CLIP/ID of the data set, each once"
                todo = f"Known are {', '.join(sorted(known)[:8])}, ..."
                raise wrong(f"{file}: {subject}", expected, f"{person!r}", todo)
            owner[person] = str(subject)
    named = {}
    for name, clip in clips.items():
        subjects = tuple(owner.get(person, person) for person in clip.subjects)
        named[name] = clip.model_copy(update={"subjects": subjects})
    for subject, splits in _splits_of(named).items():
        if len(splits) > 1:
            todo = "Put all matches of a person into one split, or correct the registry."
            raise wrong(f"{file}: {subject}", "one split", " and ".join(sorted(splits)), todo)
    return named


def _splits_of(clips: Mapping[str, ReleasedSequence]) -> dict[str, set[str]]:
    found: dict[str, set[str]] = {}
    for clip in clips.values():
        for subject in clip.subjects:
            found.setdefault(subject, set()).add(clip.split)
    return found


def check_data_set(folder: Path, hidden: Path | None = None) -> CheckReport:
    """Verify what release.json states: files, splits, licences, numbers, and 3D against boxes.

    Without `hidden`, the truth of the test part is not verified.

    Raises:
        InputError: there is no such data set.
    """
    manifest = read_data_set(folder)
    findings = [*_file_findings(folder, hidden, manifest), *_statement_findings(manifest)]
    figures: dict[str, ClipFigures] = {}
    for split in dict.fromkeys(clip.split for clip in manifest.clips.values()):
        part = folder / split if split != "test" else hidden
        if part is None:
            continue
        try:
            report = check(part, pitch=manifest.pitch)
            figures |= report.clips
            for found in report.findings:
                where = tuple(f"{split}/{place}" for place in found.where)
                findings.append(found.model_copy(update={"where": where}))
            for name, counted in count([part]).clips.items():
                if not _equal(manifest.statistics.clips.get(name), counted):
                    findings.append(_damage("count", "statistics differ from the poses", name))
        except InputError as error:
            findings.append(_damage("unreadable", str(error), split))
        for name, clip in manifest.clips.items():
            try:
                findings += _clip_findings(part, name, clip) if clip.split == split else ()
            except InputError as error:
                findings.append(_damage("unreadable", str(error), f"{split}: {name}"))
    return CheckReport(clips=figures, findings=tuple(findings))


def _damage(fault: str, says: str, *where: str) -> Finding:
    return Finding(fault=fault, kind="damage", where=where, says=says)


def _equal(stated: ClipStatistics | None, counted: ClipStatistics) -> bool:
    if stated is None or len(stated.trajectories_m) != len(counted.trajectories_m):
        return False
    same = stated.model_copy(update={"trajectories_m": counted.trajectories_m}) == counted
    return same and np.allclose(stated.trajectories_m, counted.trajectories_m, rtol=1e-6, atol=1e-6)


def _file_findings(
    folder: Path, hidden: Path | None, manifest: DataSetManifest
) -> Iterator[Finding]:
    """Yield files that are gone, changed or not listed, and truth in the public test part."""
    for place, files in ((folder, manifest.files), (hidden, manifest.hidden)):
        if place is None:
            continue
        listed = {file.path for file in files}
        there = {path.relative_to(place).as_posix() for path in place.rglob("*") if path.is_file()}
        if gone := sorted(listed - there):
            yield _damage("missing_files", f"files of {place.name} are gone", *gone)
        if new := sorted(there - listed - {DATA_SET}):
            yield _damage("unlisted_files", "release.json lists no such files", *new)
        if changed := changed_files(place, [file for file in files if file.path in there]):
            yield _damage("changed_files", f"files of {place.name} have other bytes", *changed)
    truth = []
    for path in sorted((folder / "test").rglob("*.npz")):
        kind = path.relative_to(folder / "test").parts[0]
        posed = kind == "cameras" and np.isfinite(read_camera_rows(path).rotation).all((1, 2)).sum()
        if posed > 1 or kind not in ("cameras", "boxes", "footage"):
            truth.append(path.relative_to(folder).as_posix())
    if truth:
        yield _damage("test_truth", "the public test part has truth that must be hidden", *truth)


def _statement_findings(manifest: DataSetManifest) -> Iterator[Finding]:
    """Yield missing licences, subjects in two splits, and totals that clips contradict."""
    paths = [file.path for file in (*manifest.files, *manifest.hidden)]
    for asset in ASSETS:
        here = any(asset in path.split("/") or f".{asset}." in path for path in paths)
        if here and not manifest.licences.get(asset, "").strip():
            yield _damage("missing_licence", "no licence is stated for these files", asset)
    for subject, splits in _splits_of(manifest.clips).items():
        if len(splits) > 1:
            says = f"it is in {' and '.join(sorted(splits))}"
            yield _damage("subject_in_two_splits", says, subject)
    stated = manifest.statistics
    whole = data_set_statistics(stated.clips, len(_splits_of(manifest.clips)))
    wrong_totals = [name for name, value in whole if value != getattr(stated, name)]
    if wrong_totals or stated.clips.keys() != manifest.clips.keys():
        says = f"clips give other totals of {', '.join(wrong_totals) or 'clips'}"
        yield _damage("count", says, DATA_SET)


def _clip_findings(part: Path, name: str, clip: ReleasedSequence) -> Iterator[Finding]:
    """Yield boxes outside the image, and poses, joints and boxes that disagree."""
    poses, model = read_poses(part / "poses" / f"{name}.npz")
    joints = read_joints(part / f"{name}.joints.npz").joints
    mine = fold_keypoints(find_body(model or ""), COCO17)(poses).swapaxes(0, 1)
    where = f"{clip.split}/{name}.joints.npz"
    if mine.shape != joints.shape or len(clip.subjects) != joints.shape[1]:
        yield _damage("count", "poses, joints and subjects are not of the same people", where)
        return
    if not np.allclose(mine, joints, rtol=0.0, atol=0.005, equal_nan=True):
        yield _damage("joints_differ", "joints are not those of the poses", where)
    for view, size in clip.views.items():
        where = f"{clip.split}/boxes/{view}.npz"
        stored = read_boxes(part / "boxes" / f"{view}.npz")
        boxes, edge = stored["boxes"], np.array(size) - 0.5
        low, high = boxes[..., :2], boxes[..., 2:]
        if ((high <= low) | (low < -0.5) | (high > edge)).any():
            yield _damage("box_outside", "a box has no area or leaves the image", where)
        for key, right in project_people(part, name, view, size).items():
            # Single precision of poses is far below a hundredth of a pixel.
            mine, same = stored[key], stored[key].shape == right.shape
            if not same or not np.allclose(mine, right, rtol=0.0, atol=0.01, equal_nan=True):
                says = f"{key}: not those of the bodies in the camera, frame by frame"
                yield _damage("boxes_differ", says, where)
