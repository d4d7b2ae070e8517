"""Inbox in object storage: complete arrivals are copied to the inbox folder.

The bucket is never changed. In the folder, a match is an arrival like any other.
"""

from __future__ import annotations

import hashlib
import json
import logging
import shutil
import tempfile
from collections import defaultdict
from collections.abc import Iterable
from pathlib import Path, PurePosixPath
from typing import Final

from data_contracts.operations import Arrival
from flows.service.inbox import REMOVED, change_state, match_id_in, printable
from flows.service.layout import PRIORITIES, StateFolder
from worldpose.errors import InputError, UsageError, WorldposeError
from worldpose.formats.files import whole_file
from worldpose.store.blobs import Entry
from worldpose.store.objects import ObjectBlobs
from worldpose.store.paths import checked_path

SCHEME: Final = "s3://"
NOT_COPIED: Final = "not copied again from the bucket: "
"""Before the reason, in that of a match that is taken in."""

LOG = logging.getLogger("worldpose.operations")


class BucketInbox:
    """Matches below one address, each in its own folder as in an inbox folder.

    The address is `s3://bucket/prefix`; credentials and endpoint come from the environment, as for
    a project.
    """

    def __init__(self, url: str, inbox: Path, state: StateFolder) -> None:
        self.url, self.inbox, self._state = url, inbox, state
        if not url.startswith(SCHEME):
            raise UsageError(
                f"--bucket {url}",
                expected="s3://bucket or s3://bucket/prefix",
                found=repr(url),
                todo="Name a bucket, as in --bucket s3://arriving/matches.",
            )
        self._objects = ObjectBlobs.at(url)
        self._file = state.folder / "bucket.json"
        kept = json.loads(self._file.read_text()) if self._file.exists() else {}
        # Fingerprints of a match's objects, of the files that became of them, and of those of a
        # copy that is on its way.
        self._copied: dict[str, list[str]] = kept
        self._since: dict[str, tuple[str, float]] = {}
        self._told: dict[str, str | None] = {}

    def fetch(self, now: float, quiet: float) -> list[str]:
        """Copy each match without recent changes; return their names.

        `now` is on the monotonic clock, `quiet` the required time without changes [s].
        """
        fetched, taken = [], self._taken_in()
        for name, objects in self._list_objects().items():
            fingerprint = _digest(
                f"{it.path}\n{it.size} {it.modified.isoformat()}" for it in objects
            )
            seen, since = self._since.get(name, ("", now))
            if seen != fingerprint:
                since = now
            self._since[name] = (fingerprint, since)
            is_copied = self._copied.get(name, [""])[0] == fingerprint
            if not is_copied and now - since < quiet:
                continue
            refused = None
            try:  # what cannot be copied stops no other match
                refused = None if is_copied else self._find_objection(name, objects)
                if not is_copied and refused is None:
                    self._copy(name, objects)
                    fetched.append(name)
                    self._keep(name, [fingerprint, self._copied[name][-1]])
            except (WorldposeError, OSError) as error:
                refused = str(error)
            self._tell(name, refused, taken.get(printable(name)))
        return fetched

    def _tell(self, name: str, refused: str | None, known: Arrival | None) -> None:
        """Log once why a match is not copied, and say it at a match that is taken in."""
        if refused is not None and self._told.get(name) != refused:
            LOG.warning("%s/%s is not taken: %s", self.url, name, refused)
        self._told[name] = refused
        if known is None or _said_of(known, refused) == known.reason:
            return
        with self._state.only_one("arrivals", wait=False) as is_held:
            arrival = self._taken_in().get(known.name) if is_held else None  # if not, the next time
            if arrival is not None:
                reason = _said_of(arrival, refused)
                self._state.write_arrival(change_state(arrival, "taken", reason))

    def _taken_in(self) -> dict[str, Arrival]:
        """Return the matches of the inbox folder that are taken in, by name."""
        found = self._state.arrivals().items()
        return {name: arrival for name, arrival in found if arrival.state == "taken"}

    def _list_objects(self) -> dict[str, list[Entry]]:
        """Return objects by match name, for all matches with a match.yaml."""
        found: dict[str, list[Entry]] = defaultdict(list)
        listed = self._objects.all_entries()
        folders = {str(folder) for each in listed for folder in PurePosixPath(each.path).parents}
        for each in listed:
            if each.size == 0 and each.path.rstrip("/") in folders:
                continue  # consoles of object storage mark a folder so
            parts = each.path.split("/")
            depth = 2 if parts[0] in PRIORITIES and len(parts) > 2 else 1
            if len(parts) > depth:
                found["/".join(parts[:depth])].append(each)
        return {
            name: objects
            for name, objects in sorted(found.items())
            if any(each.path == f"{name}/match.yaml" for each in objects)
        }

    def _find_objection(self, name: str, objects: list[Entry]) -> str | None:
        """Return why the match cannot be copied to the folder; None if it can."""
        try:
            for each in objects:
                checked_path(each.path)
        except InputError as error:
            return str(error)
        target, made = self.inbox / name, self._copied.get(name, [])[1:]
        if not target.exists():
            return None
        if _fingerprint_files(target) in made:
            return self._find_loss(name, {it.path.removeprefix(f"{name}/") for it in objects})
        why = "was changed here since it was copied: move it away" if made else "is there already"
        return f"{target} {why}"

    def _find_loss(self, name: str, paths: set[str]) -> str | None:
        """Return what a match that is taken in would lose by the objects `paths`; None if nothing.

        Rules of a bucket and tidy-ups remove objects, and names are used again.
        """
        target, arrival = self.inbox / name, self._taken_in().get(printable(name))
        if arrival is None:
            return None
        files = {it.relative_to(target).as_posix() for it in target.rglob("*") if it.is_file()}
        if gone := sorted(files - paths):
            return (
                f"{target} is taken in, and the bucket has {len(gone)} of its files no more, as "
                f"{gone[0]}: put them back, or move the folder away"
            )
        with tempfile.TemporaryDirectory() as folder:
            self._objects.download(f"{name}/match.yaml", Path(folder) / "match.yaml")
            found = match_id_in(Path(folder) / "match.yaml")
        if found == arrival.match_id:
            return None
        return (
            f"{target} is taken in as {arrival.match_id}, and match_id in the bucket is {found}: "
            "upload another match under another name, or move the folder away"
        )

    def _copy(self, name: str, objects: list[Entry]) -> None:
        """Copy the whole match to the folder; the copy before is set aside, for that before it."""
        target = self.inbox / name
        draft = target.with_name(f".{target.name}.arriving")
        shutil.rmtree(draft, ignore_errors=True)
        for each in objects:
            self._objects.download(each.path, draft / each.path.removeprefix(f"{name}/"))
        self._keep(name, [*self._copied.get(name, [""]), _fingerprint_files(draft)])
        if target.exists():
            before = self.inbox / REMOVED / "bucket" / name
            shutil.rmtree(before, ignore_errors=True)
            before.parent.mkdir(parents=True, exist_ok=True)
            LOG.warning("%s: the copy before is now %s", target, target.rename(before))
        draft.rename(target)

    def _keep(self, name: str, fingerprints: list[str]) -> None:
        self._copied[name] = fingerprints
        with whole_file(self._file) as draft:
            draft.write_text(json.dumps(self._copied, indent=2) + "\n")


def _said_of(arrival: Arrival, refused: str | None) -> str:
    said = arrival.reason.partition(NOT_COPIED)[0].removesuffix("; ")
    return said if refused is None else "; ".join(filter(None, (said, f"{NOT_COPIED}{refused}")))


def _fingerprint_files(folder: Path) -> str:
    files = ((path, path.stat()) for path in folder.rglob("*") if path.is_file())
    return _digest(
        f"{it.relative_to(folder)}\n{about.st_size} {about.st_mtime_ns}" for it, about in files
    )


def _digest(lines: Iterable[str]) -> str:
    return hashlib.sha256("\n".join(sorted(lines)).encode()).hexdigest()
