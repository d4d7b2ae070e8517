"""Inbox in object storage: complete arrivals are copied to the inbox folder.

The bucket is never changed. In the folder, a match is an arrival like any other.
"""

from __future__ import annotations

import hashlib
import json
import logging
import shutil
from collections import defaultdict
from collections.abc import Iterable
from contextlib import suppress
from pathlib import Path
from typing import Final

from flows.service.layout import PRIORITIES, StateFolder
from worldpose.errors import InputError, UsageError
from worldpose.formats.files import whole_file
from worldpose.store.blobs import Entry
from worldpose.store.objects import ObjectBlobs
from worldpose.store.paths import checked_path

SCHEME: Final = "s3://"

LOG = logging.getLogger("worldpose.operations")


class BucketInbox:
    """Matches below one address, each in its own folder as in an inbox folder.

    The address is `s3://bucket/prefix`; credentials and endpoint come from the environment, as for
    a project.
    """

    def __init__(self, url: str, inbox: Path, state: StateFolder) -> None:
        self.url, self.inbox = url, inbox
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
        self._told: dict[str, str] = {}

    def fetch(self, now: float, quiet: float) -> list[str]:
        """Copy each match without recent changes; return their names.

        `now` is on the monotonic clock, `quiet` the required time without changes [s].
        """
        fetched = []
        for name, objects in self._list_objects().items():
            fingerprint = _digest(
                f"{it.path}\n{it.size} {it.modified.isoformat()}" for it in objects
            )
            seen, since = self._since.get(name, ("", now))
            if seen != fingerprint:
                since = now
            self._since[name] = (fingerprint, since)
            if self._copied.get(name, [""])[0] == fingerprint or now - since < quiet:
                continue
            refused = self._find_objection(name, objects)
            if refused is not None:
                if self._told.get(name) != refused:
                    LOG.warning("%s/%s is not taken: %s", self.url, name, refused)
                self._told[name] = refused
            else:
                self._copy(name, objects)
                fetched.append(name)
                self._keep(name, [fingerprint, self._copied[name][-1]])
                self._told.pop(name, None)
        return fetched

    def _list_objects(self) -> dict[str, list[Entry]]:
        """Return objects by match name, for all matches with a match.yaml."""
        found: dict[str, list[Entry]] = defaultdict(list)
        for each in self._objects.all_entries():
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
        if not target.exists() or _fingerprint_files(target) in made:
            return None
        why = "was changed here since it was copied: move it away" if made else "is there already"
        return f"{target} {why}"

    def _copy(self, name: str, objects: list[Entry]) -> None:
        """Copy the whole match to the folder, replacing an earlier copy."""
        target = self.inbox / name
        draft = target.with_name(f".{target.name}.arriving")
        replaced = target.with_name(f".{target.name}.replaced")
        for left in (draft, replaced):
            shutil.rmtree(left, ignore_errors=True)
        for each in objects:
            self._objects.download(each.path, draft / each.path.removeprefix(f"{name}/"))
        self._keep(name, [*self._copied.get(name, [""]), _fingerprint_files(draft)])
        with suppress(FileNotFoundError):
            target.rename(replaced)
        draft.rename(target)
        shutil.rmtree(replaced, ignore_errors=True)

    def _keep(self, name: str, fingerprints: list[str]) -> None:
        self._copied[name] = fingerprints
        with whole_file(self._file) as draft:
            draft.write_text(json.dumps(self._copied, indent=2) + "\n")


def _fingerprint_files(folder: Path) -> str:
    files = ((path, path.stat()) for path in folder.rglob("*") if path.is_file())
    return _digest(
        f"{it.relative_to(folder)}\n{about.st_size} {about.st_mtime_ns}" for it, about in files
    )


def _digest(lines: Iterable[str]) -> str:
    return hashlib.sha256("\n".join(sorted(lines)).encode()).hexdigest()
