"""One data set of the runs of several matches, and the check of all that it states."""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import fields, replace
from importlib.metadata import version
from itertools import chain
from pathlib import Path
from typing import Final, Literal

import numpy as np

from data_contracts import release as contracts
from data_contracts.arrays import Floats
from data_contracts.conventions import COCO17
from data_contracts.run import StoredFile
from flows.results import best_results
from flows.results.best_results import Origin
from flows.results.data_set_subjects import name_subjects, subject_fits
from flows.results.dataset import check, count
from flows.results.export import keep_run
from flows.results.run_cameras import Lens, followed_lenses, view_changes
from flows.results.tool_exports import filmed_cameras
from worldpose.body.body_file import find_body
from worldpose.body.keypoints import fold_keypoints
from worldpose.body.model import BodyModel
from worldpose.body.occlusions import visible_shares
from worldpose.dataset import manifest as manifests
from worldpose.dataset.contents import camera_files
from worldpose.dataset.plausibility import mean_visible, rig_findings
from worldpose.dataset.statistics import clip_statistics, data_set_statistics, read_places
from worldpose.dataset.subjects import subject_findings, write_subjects
from worldpose.errors import InputError, UsageError
from worldpose.formats import challenge, joints_file, release_cameras
from worldpose.formats.archives import Member, read_archive, write_archive, wrong
from worldpose.geometry.cameras import Camera
from worldpose.ingest.footage import unit_frames
from worldpose.ingest.match_folder import read_match
from worldpose.ingest.pitch_file import NO_PITCH
from worldpose.ingest.registration import digest_of_files
from worldpose.store.runs import unpin_run
from worldpose.store.store import Store

ASSETS: Final = ("poses", "joints", "cameras", "boxes", "footage")
"""Kinds of files, each with a licence."""
FootageForm = Literal["none", "digest", "copy"]


def write_data_set(
    store: Store,
    origins: Sequence[tuple[Origin, contracts.Split]],
    out: Path,
    name: str,
    licences: Mapping[str, str],
    *,
    hidden: Path | None = None,
    footage: FootageForm = "none",
    subjects: Path | None = None,
) -> contracts.DataSetManifest:
    """Write a new folder with all clips of several runs, and release.json; pin the runs.

    `train` and `val` have poses, joints, cameras and boxes; `test` has boxes, and cameras with the
    pose of the first frame alone: the rest is in the new folder `hidden`. Licences are texts by
    kind of file; `subjects` is a YAML file with lists of MATCH/NAME or MATCH/CLIP/ID.
    """
    tested = any(split == "test" for _, split in origins)
    public, secret = out.resolve(), (hidden or out).resolve()
    nested = public.is_relative_to(secret) or secret.is_relative_to(public)
    if tested != (hidden is not None) or (hidden and nested):
        todo = "Name both --test MATCH and --hidden FOLDER, a folder that you do not publish."
        expected = "a folder for the test part's truth, not in --out nor around it"
        raise _refuse("--hidden", expected, hidden, todo)
    for place in (out, hidden or out):
        if place.exists():
            raise _refuse(f"{place}", "a new folder", "one that exists", "Choose another folder.")
    out.parent.mkdir(parents=True, exist_ok=True)
    with (
        ExitStack() as undo,
        tempfile.TemporaryDirectory(prefix=f".{out.name}.", dir=out.parent) as workshop,
    ):
        # First, so that no run can be collected while its files are written.
        for origin, _ in origins:
            if keep_run(store, origin, name):
                undo.callback(unpin_run, store.blobs, origin.spec.match_id, f"release-{name}")
        draft, truth = Path(workshop) / "public", Path(workshop) / "hidden"
        clips: dict[str, contracts.ReleasedSequence] = {}
        models: dict[str, BodyModel] = {}
        sources: dict[Path, list[tuple[str, tuple[Origin, str]]]] = {}
        for origin, split in origins:
            part = truth if split == "test" else draft / split
            rig = followed_lenses(origin.static_cameras, f"release of {origin.spec.match_id}")
            for clip in origin.clips:
                label = f"{origin.spec.match_id}_{clip}".replace(".", "_")
                if label in clips:
                    todo = "Name each match once, and rename clips whose names differ by dots."
                    raise _refuse(label, "one clip of this name", "two", todo)
                clips[label], model = _write_clip(
                    origin, clip, label, split, Path(workshop), footage, rig
                )
                other = models.setdefault(model.name, model)
                arrays = ([getattr(each, f.name) for each in (model, other)] for f in fields(model))
                if not all(np.array_equal(*pair) for pair in arrays):
                    todo = "Install them under different names, and run a match again."
                    raise _refuse(model.name, "one body file of this name", "two", todo)
                sources.setdefault(part, []).append((label, (origin, clip)))
        clips = name_subjects(clips, subjects)
        for part, of in sources.items():
            fits = (subject_fits(label, clips[label].subjects, *where) for label, where in of)
            write_subjects(part / "subjects.npz", chain.from_iterable(fits))
        if tested:
            secrets = {name: clip for name, clip in clips.items() if clip.split == "test"}
            manifests.write_rigs(truth, {name: clip.rig or {} for name, clip in secrets.items()})
            clips |= {name: clip.model_copy(update={"rig": None}) for name, clip in secrets.items()}
        parts = [part for part in (draft / "train", draft / "val", truth) if part.is_dir()]
        counted = {part: count([part]) for part in parts}
        if tested:
            tests = counted.pop(truth).model_dump_json(indent=2)
            (truth / "statistics.json").write_text(f"{tests}\n", encoding="utf-8")
        told = {each: n for part in counted.values() for each, n in part.clips.items()}
        manifest = contracts.DataSetManifest(
            release=name,
            worldpose=version("worldpose"),
            pitch=all(origin.spec.pitch != NO_PITCH for origin, _ in origins),
            licences=dict(licences),
            clips=clips,
            statistics=_count_public(told, clips),
            files=(),
            hidden=_listed(truth),
        )
        for found in _statement_findings(manifest):
            todo = "Add --licence KIND=FILE, or put all matches of a person into one split."
            raise wrong(f"{out}: {found.where[0]}", "no contradiction", found.says, todo)
        from worldpose.reports.data_set import data_set_page  # late: it loads matplotlib, 0.5 s

        checks = {}
        for part in parts:
            report = check(part, pitch=manifest.pitch, models=models)
            people = subject_findings(part, {label: clips[label] for label, _ in sources[part]})
            findings = *report.findings, *people
            checks[part.name] = report.model_copy(update={"findings": findings})
        if tested:
            checks[truth.name] = checks[truth.name].model_copy(update={"clips": {}})
        page = data_set_page(name, manifest.statistics, checks, manifest)
        (draft / "datasheet.html").write_text(page, encoding="utf-8")
        manifest = manifest.model_copy(update={"files": _listed(draft)})
        manifests.write_manifest(draft, manifest)
        if hidden is not None:
            hidden.parent.mkdir(parents=True, exist_ok=True)
            shutil.move(truth, hidden)
        draft.replace(out)
        undo.pop_all()
    return manifest


def _refuse(where: str, expected: str, found: object, todo: str) -> UsageError:
    return UsageError(where, expected=expected, found=f"{found}", todo=todo)


def _listed(folder: Path) -> tuple[StoredFile, ...]:
    return manifests.released_files(folder, [path for path in folder.rglob("*") if path.is_file()])


def _write_clip(
    origin: Origin,
    clip: str,
    name: str,
    split: contracts.Split,
    root: Path,
    footage: FootageForm,
    rig: tuple[Mapping[str, Camera], Mapping[str, Lens]],
) -> tuple[contracts.ReleasedSequence, BodyModel]:
    """Write the files of one clip below `root`, the truth of a test part apart from the rest.

    Returns the entry of the clip, and its body model. The rig has static cameras with Brown's
    lenses, and the errors of those that had another.
    """
    public = root / "public" / split
    part = root / "hidden" if split == "test" else public
    model, poses, people, _ = best_results.fitted_bodies(origin.run, clip)
    tracks, spec = replace(origin, definition="body").tracks(clip), origin.spec
    joints_file.write_poses(part / "poses" / f"{name}.npz", poses, model.name)
    joints_file.write_joints(part / f"{name}.joints.npz", tracks)
    manifests.write_frame_rates(part, {name: spec.fps})
    views, videos, images = {}, {}, {}
    for view, camera in filmed_cameras(origin, clip).items():
        label = name + view.removeprefix(clip)
        width, height = camera.image_size.reshape(-1, 2)[0].tolist()
        views[label] = width, height
        release_cameras.write_moving_camera(part / "cameras" / f"{label}.npz", camera)
        boxes = project_people(part, name, label, views[label], model)
        write_archive(part / "boxes" / f"{label}.npz", boxes)
        if split == "test":
            challenge.write_challenge_camera(public / f"cameras/{label}.npz", camera, 2026)
            write_archive(public / "boxes" / f"{label}.npz", boxes)
        if footage != "none":
            videos[label] = _write_footage(origin, view, public / "footage" / label, footage)
            images[label] = unit_frames(spec, view).number(spec.clips_of(view)[0].first_frame)
    changes, still = view_changes(origin.run, clip), dict[str, contracts.RigCamera]()
    for camera_id, filmed in origin.static_cameras.items():
        own = tuple(each for each in changes if each.camera == camera_id)
        visible, brown = None, rig[0].get(camera_id)
        if brown is not None:
            path = part / "cameras" / name / f"{camera_id}.npz"
            release_cameras.write_static_camera(path, brown.to_calibration(camera_id))
            visible = None if own else mean_visible(tracks.joints, brown)
        width, height = filmed.image_size.tolist()
        still[camera_id] = contracts.RigCamera(
            image_size=(width, height), visible=visible, lens=rig[1].get(camera_id), changes=own
        )
    found = best_results.tracked_people(origin.run, clip)[1]
    named = {person: track.name or f"{clip}/{person}" for person, track in found.items()}
    released = contracts.ReleasedSequence(
        split=split,
        match_id=spec.match_id,
        run_id=origin.run.record.run_id,
        clip_id=clip,
        usability=origin.run.record.usability,
        first_frame=int(tracks.frames[0]),
        frames=len(tracks.frames),
        fps=spec.fps,
        body_model=model.name,
        subjects=tuple(f"{spec.match_id}/{named[person]}" for person in people.tolist()),
        views=views,
        rig=still,
        footage=videos,
        first_images=images,
    )
    return released, model


def _write_footage(origin: Origin, view: str, out: Path, form: FootageForm) -> StoredFile:
    folder = Path(origin.registration.folder)
    video = read_match(folder, whose=None).videos.get(view)
    source = "" if video is None else video.relative_to(folder).as_posix()
    digest = origin.registration.digest_of(source)
    if video is None or digest is None:
        todo = "Add it to the match folder and run again, or choose --footage none."
        raise wrong(f"{folder}: {view}", "its video", "none", todo)
    files = [path for path in (video, *video.rglob("*")) if path.is_file()]
    if form == "copy":
        copied = out.with_name(f"{out.name}{video.suffix}")
        copied.parent.mkdir(parents=True, exist_ok=True)
        (shutil.copytree if video.is_dir() else shutil.copyfile)(video, copied)
        if (found := digest_of_files(copied)) != digest:
            todo = f"Register it again and run: worldpose ingest {folder}."
            raise wrong(f"{video}", f"the registered video, {digest}", found, todo)
        source = "/".join(copied.parts[-3:])
    return StoredFile(path=source, size=sum(f.stat().st_size for f in files), sha256=digest)


def project_people(
    part: Path, clip: str, view: str, size: tuple[int, int], model: BodyModel
) -> dict[str, Floats]:
    """Return boxes (frames, persons, 4) [px] and visibility (frames, persons) of a clip's files.

    Boxes are around the surfaces of bodies, within the image; NaN outside. Visibility is the share
    of joints in the image that no nearer person hides. The image has width and height `size` [px].
    """
    poses, _ = joints_file.read_poses(part / "poses" / f"{clip}.npz")
    camera = release_cameras.read_camera(part / "cameras" / f"{view}.npz", size)
    joints = joints_file.read_joints(part / f"{clip}.joints.npz").joints
    truth = challenge.challenge_truth(model, poses, camera)
    boxes = np.full((*joints.shape[:2], 4), np.nan)
    boxes[:, truth.persons] = truth.clip.boxes
    return {"boxes": boxes, "visibility": visible_shares(joints, camera)}


def _count_public(
    counted: Mapping[str, contracts.ClipStatistics], clips: Mapping[str, contracts.ReleasedSequence]
) -> contracts.DataSetStatistics:
    """Return the statistics of all clips but those of the test part."""
    public = (clip.subjects for clip in clips.values() if clip.split != "test")
    return data_set_statistics(counted, len(set().union(*public)))


def check_data_set(folder: Path, hidden: Path | None = None) -> contracts.CheckReport:
    """Verify what release.json states: files, splits, licences, numbers, and 3D against boxes.

    Without `hidden`, the truth of the test part is not verified. InputError without a data set.
    """
    manifest = manifests.read_data_set(folder)
    findings = [*_file_findings(folder, hidden, manifest), *_statement_findings(manifest)]
    figures: dict[str, contracts.ClipFigures] = {}
    rigs: dict[tuple[str, str], bytes] = {}
    parts: dict[str, Path | None] = {**{s: folder / s for s in ("train", "val")}, "test": hidden}
    clips = dict(manifest.clips)
    for name, clip in manifest.clips.items():
        if clip.split == "test" and clip.rig is not None:
            says = "release.json states the rig of a hidden clip"
            findings.append(_damage("test_truth", says, name))
    try:
        secrets = None if hidden is None else manifests.read_rigs(hidden)
    except InputError as error:
        secrets = {}
        findings.append(_damage("unreadable", str(error), "test: rigs.json"))
    for name, clip in clips.items():
        if clip.split == "test":
            rig = None if secrets is None else secrets.get(name, {})
            clips[name] = clip.model_copy(update={"rig": rig})
    for split, part in parts.items():
        own = {name: clip for name, clip in clips.items() if clip.split == split}
        files = manifest.hidden if split == "test" else manifest.files
        told = {file.path for file in files}
        listed = f"{'' if split == 'test' else f'{split}/'}subjects.npz" in told
        # Older releases have neither rigs nor shapes of subjects.
        is_older = not listed and all(clip.rig is None for clip in own.values())
        if part is not None and own and not (is_older and not (part / "subjects.npz").exists()):
            findings += subject_findings(part, own)
    for name, clip in clips.items():
        part = parts[clip.split]
        try:
            findings += _view_findings(folder / clip.split, part, name, clip)
            if part is not None:
                findings += rig_findings(part, name, clip, rigs)
                findings += _clip_findings(part, name, clip, manifest.statistics.clips.get(name))
                report = check(part, pitch=manifest.pitch, only=name)
                figures |= report.clips
                for found in report.findings:
                    where = tuple(f"{clip.split}/{place}" for place in found.where)
                    findings.append(found.model_copy(update={"where": where}))
        except InputError as error:
            findings.append(_damage("unreadable", str(error), f"{clip.split}: {name}"))
    return contracts.CheckReport(clips=figures, findings=tuple(findings))


def _damage(fault: str, says: str, *where: str) -> contracts.Finding:
    return contracts.Finding(fault=fault, kind="damage", where=where, says=says)


def _numbers(clip: contracts.ClipStatistics) -> Floats:
    return np.array([clip.frames, clip.seconds, clip.persons, clip.poses, *clip.trajectories_m])


def _equal(one: Floats, two: Floats, off: float = 1e-6) -> bool:
    return one.shape == two.shape and np.allclose(one, two, rtol=0.0, atol=off, equal_nan=True)


def _file_findings(
    folder: Path, hidden: Path | None, manifest: contracts.DataSetManifest
) -> Iterator[contracts.Finding]:
    """Yield files that are gone, changed or not listed, and truth in the public test part."""
    for place, files in ((folder, manifest.files), (hidden, manifest.hidden)):
        if place is None:
            continue
        listed = {file.path for file in files}
        there = {path.relative_to(place).as_posix() for path in place.rglob("*") if path.is_file()}
        if gone := sorted(listed - there):
            yield _damage("missing_files", f"files of {place.name} are gone", *gone)
        if new := sorted(there - listed - {manifests.DATA_SET}):
            yield _damage("unlisted_files", "release.json lists no such files", *new)
        if changed := manifests.changed_files(place, [f for f in files if f.path in there]):
            yield _damage("changed_files", f"files of {place.name} have other bytes", *changed)
    truth = []
    for path in sorted((folder / "test").rglob("*.npz")):
        name = path.relative_to(folder).as_posix()
        kind, poses = name.split("/")[1], np.empty(0)
        try:
            poses = release_cameras.read_camera_rows(path).rotation if kind == "cameras" else poses
        except InputError as error:
            yield _damage("unreadable", str(error), name)
        still = kind == "cameras" and name.count("/") > 2
        if still or np.isfinite(poses).sum() > 9 or kind not in ("cameras", "boxes", "footage"):
            truth.append(name)
    if truth:
        yield _damage("test_truth", "the public test part has truth that must be hidden", *truth)


def _statement_findings(manifest: contracts.DataSetManifest) -> Iterator[contracts.Finding]:
    """Yield missing licences, subjects in two splits, and totals that clips contradict."""
    filmed = any(clip.footage for clip in manifest.clips.values())
    for asset in ASSETS if filmed else ASSETS[:-1]:
        if not manifest.licences.get(asset, "").strip():
            yield _damage("missing_licence", "no licence of these files is stated", asset)
    splits: dict[tuple[str, str], set[str]] = {}
    for clip in manifest.clips.values():
        for member in (("match", clip.match_id), *(("subject", each) for each in clip.subjects)):
            splits.setdefault(member, set()).add(clip.split)
    for (kind, one), of in splits.items():
        if len(of) > 1:
            says = f"the {kind} is in {' and '.join(sorted(of))}"
            yield _damage(f"{kind}_in_two_splits", says, one)
    stated = manifest.statistics
    whole = _count_public(stated.clips, manifest.clips)
    others = [name for name, value in whole if value != getattr(stated, name)]
    public = {name for name, clip in manifest.clips.items() if clip.split != "test"}
    if others or stated.clips.keys() != public:
        says = f"clips give other totals of {', '.join(others) or 'clips'}"
        yield _damage("count", says, manifests.DATA_SET)


def _view_findings(
    public: Path, part: Path | None, name: str, clip: contracts.ReleasedSequence
) -> Iterator[contracts.Finding]:
    """Yield what is wrong in published views, footage, cameras and boxes.

    `part` has the truth of a test part; None if it is not there.
    """
    if {path.stem for path in camera_files(public, name, (name,))[0]} != clip.views.keys():
        yield _damage("views_differ", "views are not those of the cameras' files", name)
    for path in (public / "footage").glob("*"):
        video = clip.footage.get(view := path.name if path.is_dir() else path.stem)
        own = view in clip.views and (video is None or video.path != "/".join(path.parts[-3:]))
        if own or (video is not None and video.sha256 != digest_of_files(path)):
            yield _damage("footage_differs", "path or digest is not that of the copy", view)
    for view, size in clip.views.items():
        where = tuple(f"{clip.split}/{kind}/{view}.npz" for kind in ("boxes", "cameras"))
        folders = public, part or public
        boxes = [_read_boxes(folder, view) for folder in folders]
        low, high = np.split(boxes[0]["boxes"], 2, axis=-1)
        if ((high <= low) | (low < -0.5) | (high > np.array(size) - 0.5)).any():
            yield _damage("box_outside", "a box has no area or leaves the image", where[0])
        if not all(map(_equal, *(each.values() for each in boxes))):
            yield _damage("boxes_differ", "boxes are not the hidden ones", where[0])
        rows = [release_cameras.read_camera_rows(f / "cameras" / f"{view}.npz") for f in folders]
        # Broadcast images are whole: the principal point is near their middle.
        if (abs(rows[0].intrinsics[:, :2, 2] / size - 0.5) > 0.125).any():
            yield _damage("views_differ", "the image size is not that of the camera", view)
        known = [(c.intrinsics, c.distortion, c.rotation[0], c.translation[0]) for c in rows]
        if not all(map(_equal, *known)):
            yield _damage("camera_differs", "the camera is not the hidden one", where[1])


def _read_boxes(part: Path, view: str) -> dict[str, Floats]:
    members = {
        "boxes": Member(("frames", "persons", 4), "float"),
        "visibility": Member(("frames", "persons"), "float"),
    }
    return read_archive(part / "boxes" / f"{view}.npz", members)


def _clip_findings(
    part: Path, name: str, clip: contracts.ReleasedSequence, stated: contracts.ClipStatistics | None
) -> Iterator[contracts.Finding]:
    """Yield statements that disagree with the poses, joints and boxes of the clip."""
    poses, model = joints_file.read_poses(part / "poses" / f"{name}.npz")
    tracks = joints_file.read_joints(part / f"{name}.joints.npz")
    joints, counted = tracks.joints, clip_statistics(read_places(part, name), clip.fps)
    if stated is not None and not _equal(_numbers(stated), _numbers(counted)):
        yield _damage("count", "statistics differ from the poses", name)
    rate = manifests.clip_frame_rate(manifests.read_frame_rates(part), name)
    facts = {"fps": rate, "body_model": model, "frames": len(joints)}
    for key, found in {**facts, "first_frame": int(tracks.frames.min(initial=1 << 40))}.items():
        if found != getattr(clip, key):
            yield _damage("statement_differs", f"{key}: {found} in the files", name)
    body = find_body(model or "")
    mine = fold_keypoints(body, COCO17)(poses).swapaxes(0, 1)
    where = f"{clip.split}/{name}.joints.npz"
    if mine.shape != joints.shape or len(clip.subjects) != joints.shape[1]:
        yield _damage("count", "poses, joints and subjects are not of the same people", where)
        return
    if not _equal(mine, joints, 0.005):
        yield _damage("joints_differ", "joints are not those of the poses", where)
    for view, size in clip.views.items():
        where = f"{clip.split}/boxes/{view}.npz"
        stored = _read_boxes(part, view)
        for key, right in project_people(part, name, view, size, body).items():
            # Single precision of poses is far below a hundredth of a pixel.
            if not _equal(stored[key], right, 0.01):
                says = f"{key}: not those of the bodies in the camera, frame by frame"
                yield _damage("boxes_differ", says, where)
