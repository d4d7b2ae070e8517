"""Clicks of an annotation tool as the clicked markings of a match folder."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Collection, Sequence
from dataclasses import dataclass, field, replace
from difflib import get_close_matches
from pathlib import Path, PurePosixPath
from typing import Final, TypeAlias

import numpy as np

from data_contracts.arrays import Floats
from data_contracts.broadcast_calibration import KeyFrame, KeyFrames
from data_contracts.match import CameraSpec, MatchSpec
from data_contracts.pitch import PitchSpec
from data_contracts.records import Record
from data_contracts.static_calibration import ClickedMarkings
from worldpose.errors import InputError
from worldpose.formats.annotations.marked_images import (
    IMAGE_NAME,
    SOCCERNET_MARKINGS,
    MarkedImage,
    read_marked_images,
)
from worldpose.formats.calibration_files import known_id
from worldpose.formats.files import whole_file
from worldpose.ingest.annotations import clicked_file, key_frames_file
from worldpose.ingest.match_folder import read_spec
from worldpose.ingest.pitch_file import pitch_file, read_pitch, require_free_pitch
from worldpose.pitch.laws import prescribed_points
from worldpose.pitch.template import PitchTemplate
from worldpose.video.names import frame_numbers

COORDINATES: Final = re.compile(r"\(?\s*(-?\d+(?:\.\d+)?)\s*[,;_ ]\s*(-?\d+(?:\.\d+)?)\s*\)?")
"""A label that is a place, such as `(16.5, 13.84)` [m]."""
SNAP_M: Final = 0.1
"""A place closer to a known point than this is that point [m]: labels are rounded."""
Place: TypeAlias = tuple[float, float] | tuple[float, float, float]


@dataclass(frozen=True)
class RepeatedClick:
    """A label that was clicked a second time in one image.

    Attributes:
        owner: the static camera, or the clip.
        label: label as in the file.
        names: names of the first click and of the repeated click, in the match folder.
        pixels: pixels of both clicks [px].
    """

    owner: str
    image: str
    label: str
    names: tuple[str, str]
    pixels: tuple[tuple[float, float], tuple[float, float]]


@dataclass
class ImportedClicks:
    """Report of an import.

    Attributes:
        files: written, relative to the match folder.
        clicks: number of clicks and drawn lines, by camera or clip.
        own_points: points that the rules do not name, with their places [m, world]: x, y of a point
            on the surface, x, y, z of a copy of a point whose height is known.
        notes: sentences about what was left out.
        mirrored: whether the labels' y axis points towards the near side; None without coordinates.
    """

    files: list[str] = field(default_factory=list)
    clicks: dict[str, int] = field(default_factory=dict)
    own_points: dict[str, Place] = field(default_factory=dict)
    repeated: list[RepeatedClick] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)
    mirrored: bool | None = None


def import_clicks(
    file: Path,
    folder: Path,
    owner: str | None = None,
    pitch: PitchSpec | None = None,
    runs: Sequence[str] = (),
) -> ImportedClicks:
    """Write the labelled points of an annotation file into a match folder.

    The file is CVAT for images XML, Label Studio JSON, COCO keypoints JSON or SoccerNet's lines.
    Labels are names of the pitch template or SoccerNet's of lines, without regard to case and
    spaces, or places in metres: from a corner along the touch line and the goal line, or, if some
    are negative or clearly more of them are points of the pitch then, from the centre spot. On
    which side y is positive follows from the clicks: no camera above a pitch sees it mirrored.
    Places that neither the Laws nor pitch.json name become points of pitch.json. A label that is
    clicked twice in one image gives two points at one place, from which calibration tells the wrong
    one.

    `owner` is the static camera, or the broadcast view whose key frames are numbered by the images'
    names; None: the images are named after cameras. `pitch` None is the folder's or the standard
    one, and `runs`, as MATCH/NUMBER, were computed with it. InputError for an unknown label or
    image, an image of another size, clicks that exist already, places that depend on a venue's
    unknown pitch, or points to add to a pitch that has runs.
    """
    spec = read_spec(folder)
    is_unknown = pitch is None and spec.venue is not None and pitch_file(folder, spec) is None
    pitch = pitch or read_pitch(folder, spec)
    if pitch is None:
        expected = "a pitch, whose markings were clicked"
        todo = "Remove the line `pitch: none`."
        raise InputError(f"{folder / 'match.yaml'}: pitch", expected, "pitch: none", todo)
    report = ImportedClicks()
    images = _read_images(file, pitch, report)
    by_owner = _assign_images(file, images, spec, owner)
    labels = _Labels(file, images, pitch, report)
    records: dict[str, Record] = {}
    for name, (camera, given) in by_owner.items():
        own = [image.of_size((camera.width, camera.height)) for image in given]
        report.notes += [
            f"{image.name}: read is one of {image.answers} annotations, the one marked as ground "
            "truth or else the last"
            for image in own
            if image.answers > 1
        ]
        for image in own:
            if image.size != (camera.width, camera.height):
                expected = f"{camera.width} x {camera.height} px, as match.yaml has it"
                found = "{} x {} px".format(*(image.size or ()))
                todo = "Click in images of the camera's own size, or correct match.yaml."
                raise InputError(f"{file}: {image.name}", expected, found, todo)
        records |= _records(file, name, camera, own, labels)
        report.clicks[name] = sum(len(image.points) + len(image.lines) for image in own)
    for name in records:
        if (folder / name).exists():
            todo = "Move it away, or correct single clicks on the pages."
            raise InputError(str(folder / name), "no clicks there yet", "a file", todo)
    if is_unknown and (report.own_points or report.mirrored is not None):
        found = "labels with places, or clicked twice, whose points depend on it"
        todo = "Give the project that has the venue (--project), or add pitch.json."
        raise InputError(str(file), f"the pitch of venue {spec.venue!r}", found, todo)
    if report.own_points:
        require_free_pitch(folder, runs)
        known = dict(pitch.points)
        known.update(report.own_points)
        records["pitch.json"] = pitch.model_copy(update={"points": known})
    for name, record in records.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        with whole_file(folder / name) as draft:
            text = record.model_dump_json(indent=2, exclude_defaults=True, exclude_none=True)
            draft.write_text(text + "\n", encoding="utf-8")
        report.files.append(name)
    return report


def _read_images(file: Path, pitch: PitchSpec, report: ImportedClicks) -> list[MarkedImage]:
    """Return the images with points or lines, and report the shapes that are left out.

    So are polygons whose labels resemble no name of a marking: they outline other things.
    """
    markings = [*PitchTemplate.from_spec(pitch).marking_names, *SOCCERNET_MARKINGS]
    images: list[MarkedImage] = []
    unread = Counter[str]()
    for image in read_marked_images(file):
        other = {
            label
            for label in image.areas
            if _find_name(label, markings) is None and not get_close_matches(label, markings)
        }
        lines = tuple(line for line in image.lines if line[0] not in other)
        unread.update(image.left_out)
        unread.update(f"polygon of {label}" for label, _ in image.lines if label in other)
        if image.points or lines:
            images.append(replace(image, lines=lines))
    if listed := ", ".join(f"{count} {shape}" for shape, count in sorted(unread.items())):
        report.notes.append(f"shapes are left out that are no labelled points or lines: {listed}")
    if not images:
        todo = "Rename the labels; docs/reference/match_folder.md lists the names."
        raise InputError(str(file), "names of markings of the pitch", listed[:200], todo)
    return images


def _assign_images(
    file: Path, images: Sequence[MarkedImage], spec: MatchSpec, owner: str | None
) -> dict[str, tuple[CameraSpec, list[MarkedImage]]]:
    """Return camera and images by static camera or clip."""
    static = {camera.id: camera for camera in spec.static_cameras}
    views = spec.broadcast_views
    owner = owner if owner is None else known_id(owner, [*static, *views])
    if owner in views:
        return {owner: (views[owner].camera, list(images))}
    if owner is not None and owner not in static:
        todo = "Name a static camera, or a clip of the broadcast camera."
        raise InputError("--camera", f"one of {', '.join([*static, *views])}", repr(owner), todo)
    found: dict[str, tuple[CameraSpec, list[MarkedImage]]] = {}
    for image in images:
        stem = _stem(image.name)
        # Label Studio puts eight digits before the name of an uploaded file.
        short = stem if stem in static else re.sub(r"^[0-9a-f]{8}-", "", stem)
        name = owner or known_id(short, static)
        if name not in static or name in found:
            expected = (
                f"one image per static camera, named <camera>.png or the like: {', '.join(static)}"
            )
            these = f"{len(images)} images, of which this is no camera's or a second one"
            todo = "Rename the images, or import one camera: --camera NAME."
            raise InputError(f"{file}: {image.name}", expected, these, todo)
        found[name] = (static[name], [image])
    return found


def _stem(name: str) -> str:
    """Return an image's name without folders and ending; Label Studio has addresses."""

    def unquote(found: re.Match[str]) -> str:
        return bytes.fromhex(found[0].replace("%", "")).decode(errors="replace")

    place = re.sub(r"(%[0-9A-Fa-f]{2})+", unquote, name)
    named = IMAGE_NAME.search(place)
    return named[1] if named else PurePosixPath(place.replace("\\", "/")).stem


def _records(
    file: Path, owner: str, camera: CameraSpec, images: Sequence[MarkedImage], labels: _Labels
) -> dict[str, Record]:
    if camera.kind == "static":
        return {clicked_file(owner): labels.markings(owner, images[0])}
    frames: dict[int, ClickedMarkings] = {}
    numbers = frame_numbers((f"{_stem(image.name)}.png" for image in images), ends=True)
    for image in images:
        number = numbers.get(f"{_stem(image.name)}.png")
        if number is None or number in frames:
            expected = "images whose names have their frame numbers, such as frame_000084.png"
            found = "no number of one clip" if number is None else f"frame {number} again"
            todo = "Name the images by the frames of the clip's video."
            raise InputError(f"{file}: {image.name}", expected, found, todo)
        frames[number] = labels.markings(owner, image)
    return {
        key_frames_file(owner): KeyFrames(
            key_frames=tuple(
                KeyFrame(frame=number, markings=frames[number]) for number in sorted(frames)
            )
        )
    }


class _Labels:
    """Labels of a file as names of points on the pitch."""

    def __init__(
        self, file: Path, images: Sequence[MarkedImage], pitch: PitchSpec, report: ImportedClicks
    ) -> None:
        self._file, self._report = file, report
        self._pitch, self._template = pitch, PitchTemplate.from_spec(pitch)
        above = {name for name, at in prescribed_points(pitch).items() if at[2]}
        self._known = {
            name: place[:2] for name, place in self._template.points.items() if name not in above
        }
        self._frame = _label_frame(file, images, pitch, [*self._known.values()], report.notes)
        if self._frame is not None:
            report.mirrored = bool(self._frame[1, 1] < 0)

    def markings(self, owner: str, image: MarkedImage) -> ClickedMarkings:
        """Return the clicked markings of an image of a camera or clip."""
        points, seen = [], Counter[str]()
        first: dict[str, tuple[float, float]] = {}
        # Suffix of the second click with one label.
        repeated_suffix = ".again"
        for label, pixel in image.points:
            name = self._name(image, label)
            seen[name] += 1
            where = (float(pixel[0]), float(pixel[1]))
            if seen[name] > 1:
                place, names = self._place(name), (name, name + repeated_suffix)
                if seen[name] > 2:
                    names = (name, f"{name}{repeated_suffix}{seen[name]}")
                self._report.repeated.append(
                    RepeatedClick(owner, image.name, label, names, (first[name], where))
                )
                name = names[1]
                self._report.own_points[name] = place
            first.setdefault(name, where)
            points.append({"name": name, "xy": pixel.tolist()})
        drawn: dict[str, list[list[float]]] = {}
        for label, pixels in image.lines:
            drawn.setdefault(self._line(image, label), []).extend(pixels.tolist())
        lines = [{"name": name, "xy": xy} for name, xy in drawn.items()]
        return ClickedMarkings.model_validate({"points": points, "drawn": lines})

    def _place(self, name: str) -> Place:
        if name in self._report.own_points:
            return self._report.own_points[name]
        x, y, z = map(float, self._template.points[name])
        is_on_surface = name in self._known and name not in self._template.leveled
        return (x, y) if is_on_surface else (x, y, z)

    def _name(self, image: MarkedImage, label: str) -> str:
        known = _find_name(label, self._template.points)
        if known is not None:
            return known
        found = COORDINATES.fullmatch(label.strip())
        if found is None or self._frame is None:
            raise self._unknown(image, label, self._template.points)
        x, y = self._frame @ [float(found[1]), float(found[2]), 1.0]
        if abs(x) > 0.5 * self._pitch.length + 30.0 or abs(y) > 0.5 * self._pitch.width + 30.0:
            raise self._unknown(image, label, self._template.points)
        for name, place in self._known.items():
            if np.hypot(*(place - [x, y])) < SNAP_M:
                return name
        name = f"at_{x:.2f}_{y:.2f}"
        self._report.own_points[name] = (round(float(x), 4), round(float(y), 4))
        return name

    def _line(self, image: MarkedImage, label: str) -> str:
        names = self._template.marking_names
        known, theirs = _find_name(label, names), _find_name(label, SOCCERNET_MARKINGS)
        if known is None and theirs is not None:
            known = _find_name(SOCCERNET_MARKINGS[theirs], names)
        if known is None:
            raise self._unknown(image, label, names)
        return known

    def _unknown(self, image: MarkedImage, label: str, known: Collection[str]) -> InputError:
        close = get_close_matches(label, known, n=3)
        return InputError(
            f"{self._file}: {image.name}",
            expected="names of the pitch, or places in metres such as (16.5, 13.84)",
            found=repr(label[:60]) + (f"; did you mean {' or '.join(close)}?" if close else ""),
            todo="Rename the label; docs/reference/match_folder.md lists the names.",
        )


def _find_name(label: str, names: Collection[str]) -> str | None:
    """Return the name that a label means, without regard to case and spaces; None if none does."""
    if label in names:
        return label
    plain = re.sub(r"[\s_-]+", "_", label.strip()).lower()
    found = [name for name in names if re.sub(r"[\s_-]+", "_", name).lower() == plain]
    return found[0] if len(found) == 1 else None


def _label_frame(
    file: Path,
    images: Sequence[MarkedImage],
    pitch: PitchSpec,
    known: Sequence[Floats],
    notes: list[str],
) -> Floats | None:
    """Return the transformation (2, 3) of the labels' places to the world [m]; None without any.

    Places without a negative number are from a corner, unless clearly more of them are then points
    of the pitch, `known` [m], if they are from the centre spot: a camera can see one quadrant.
    """
    import cv2  # imported here: most imports need no homography

    given = []
    for image in images:
        found = [(COORDINATES.fullmatch(label.strip()), pixel) for label, pixel in image.points]
        own = [((float(m[1]), float(m[2])), pixel) for m, pixel in found if m is not None]
        given.append(own)
    places = np.array([place for own in given for place, _ in own])
    if not len(places):
        return None
    from_corner = bool((places >= 0.0).all())
    signs = []
    for own in given:
        plane, pixels = np.array([p for p, _ in own]), np.array([q for _, q in own])
        if len({tuple(p) for p in plane.tolist()}) < 4:
            continue
        homography, inliers = cv2.findHomography(plane, pixels, cv2.RANSAC, 20.0)
        if homography is None or inliers.sum() < 4:
            continue
        # Of x along the touch line and y to the far side an image, y down, is a reflection.
        depth = np.c_[plane, np.ones(len(plane))] @ homography[2]
        jacobian = np.linalg.det(homography) / depth**3
        signs.append(np.sign(np.median(jacobian[inliers.ravel() > 0])))
    if not signs or len(set(signs)) > 1:
        expected = "at least four places per image, not on one line, that agree on the side of y"
        told = "too few" if not signs else "images that contradict each other"
        todo = "Label the clicks by the names of the pitch template instead."
        raise InputError(f"{file}: labels with places", expected, told, todo)
    side = -1.0 if signs[0] > 0 else 1.0  # of y, -1 = mirrored
    half = np.array([0.5 * pitch.length, 0.5 * pitch.width])
    frames = [np.array([[1.0, 0.0, -x], [0.0, side, -side * y]]) for x, y in (half, np.zeros(2))]
    places = np.unique(places, axis=0)
    apart = [
        np.linalg.norm((places @ each[:, :2].T + each[:, 2])[:, None] - known, axis=-1)
        for each in frames
    ]
    corner, center = (int((each.min(axis=1) < SNAP_M).sum()) for each in apart)
    if from_corner and (center < corner + 2 or 2 * center <= len(places)):
        return frames[0]
    if from_corner:
        notes.append(
            f"places are from the centre spot: {center} of {len(places)} are points of the pitch "
            f"then, and {corner} if they are from a corner"
        )
    return frames[1]
