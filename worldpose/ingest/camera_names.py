"""Names that a venue gives to the cameras of its matches."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import replace
from fnmatch import fnmatchcase
from pathlib import PurePath
from typing import TYPE_CHECKING, TypeVar

from data_contracts.match import MatchSpec
from worldpose.errors import InputError
from worldpose.ingest.validation import validate_record

if TYPE_CHECKING:
    from worldpose.ingest.match_folder import MatchFolder

Named = TypeVar("Named")


def names_at_venue(
    cameras: Mapping[str, Collection[str]], patterns: Mapping[str, str], where: str
) -> dict[str, str]:
    """Return the venue's name of each camera that is called otherwise.

    A camera that has a name of the venue keeps it. Of the others, one gets the name whose pattern
    fits its own name, or that of its video without the ending: `*` is any text, `?` one letter.

    Args:
        cameras: the names of each camera, the first of which is its key.
        patterns: the pattern of each name at the venue.
        where: place of the patterns, for messages.

    Raises:
        InputError: patterns of two names fit a camera, or two cameras would have one name.
    """
    called: dict[str, str] = {}
    for camera, own in cameras.items():
        fit = [name for name, it in patterns.items() if any(fnmatchcase(each, it) for each in own)]
        if camera in patterns or not fit:
            continue
        if len(fit) > 1:
            todo = "Write patterns that exclude each other."
            raise InputError(where, f"one name whose pattern fits {camera}", ", ".join(fit), todo)
        called[camera] = fit[0]
    for name in called.values():
        both = [camera for camera in cameras if called.get(camera, camera) == name]
        if len(both) > 1:
            found, todo = ", ".join(both), "Make the pattern narrower, or rename one of them."
            raise InputError(f"{where}: {name}", "one camera whom it names", found, todo)
    return called


def names_of_spec(spec: MatchSpec, patterns: Mapping[str, str]) -> dict[str, str]:
    """Return the venue's names of the cameras of match.yaml, as `names_at_venue`."""
    own = {it.id: (it.id, PurePath(it.video or it.id).stem) for it in spec.cameras}
    return names_at_venue(own, patterns, f"settings of {spec.match_id}: cameras")


def rename_cameras(match: MatchFolder, called: Mapping[str, str]) -> MatchFolder:
    """Return a match whose cameras have other names; its files keep theirs.

    Raises:
        InputError: a new name is that of a clip.
    """
    if not called:
        return match
    content = match.spec.model_dump(mode="json")
    for camera in content["cameras"]:
        camera["id"] = called.get(camera["id"], camera["id"])
    for clip in content["clips"]:
        named, offset = clip["broadcast"], clip["broadcast_offset_frames"]
        if named is not None:
            new = [called.get(it, it) for it in ([named] if isinstance(named, str) else named)]
            clip["broadcast"] = new[0] if isinstance(named, str) else new
        if isinstance(offset, dict):
            clip["broadcast_offset_frames"] = {called.get(n, n): it for n, it in offset.items()}
    where = f"{match.folder / 'match.yaml'}, with the names of the venue"
    spec = validate_record(MatchSpec, content, where)
    names = {**called, **dict(zip(match.spec.broadcast_views, spec.broadcast_views, strict=True))}

    def renamed(found: Mapping[str, Named]) -> dict[str, Named]:
        return {names.get(name, name): each for name, each in found.items()}

    posed, lenses = renamed(match.calibrations), renamed(match.lenses)
    return replace(
        match,
        spec=spec,
        calibrations={n: each.model_copy(update={"id": n}) for n, each in posed.items()},
        detections=renamed(match.detections),
        videos=renamed(match.videos),
        clicked=renamed(match.clicked),
        stills=renamed(match.stills),
        key_frames=renamed(match.key_frames),
        lenses={n: each.model_copy(update={"id": n}) for n, each in lenses.items()},
        estimates=renamed(match.estimates),
        boxes=renamed(match.boxes),
        camera_data=renamed(match.camera_data),
        own_names={new: old for old, new in called.items()},
    )
