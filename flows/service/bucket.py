"""Inbox in object storage: complete arrivals are copied to the inbox folder.

The bucket is never changed. In the folder, a match is an arrival like any other.
"""

from __future__ import annotations

import hashlib
import json
import logging
import shutil
from collections import defaultdict
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
        self._copied: dict[str, str] = kept
        self._since: dict[str, tuple[str, float]] = {}

    def fetch(self, now: float, quiet: float) -> list[str]:
        """Copy each match without recent changes; return their names.

        `now` is on the monotonic clock, `quiet` the required time without changes [s].
        """
        fetched = []
        for name, objects in self._list_objects().items():
            fingerprint = _fingerprint(objects)
            seen, since = self._since.get(name, ("", now))
            if seen != fingerprint:
                since = now
            self._since[name] = (fingerprint, since)
            if self._copied.get(name) == fingerprint or now - since < quiet:
                continue
            if self._copy(name, objects):
                fetched.append(name)
            self._copied[name] = fingerprint
            with whole_file(self._file) as draft:
                draft.write_text(json.dumps(self._copied, indent=2) + "\n")
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

    def _copy(self, name: str, objects: list[Entry]) -> bool:
        """Copy the whole match to the folder, replacing an earlier copy."""
        target = self.inbox / name
        draft = target.with_name(f".{target.name}.arriving")
        try:
            for each in objects:
                checked_path(each.path)
        except InputError as error:
            LOG.warning("%s/%s is not taken: %s", self.url, name, error)
            return False
        shutil.rmtree(draft, ignore_errors=True)
        for each in objects:
            self._objects.download(each.path, draft / each.path.removeprefix(f"{name}/"))
        if target.exists() and name not in self._copied:
            LOG.warning("%s/%s is not taken: %s is there already", self.url, name, target)
            shutil.rmtree(draft)
            return False
        shutil.rmtree(target, ignore_errors=True)
        draft.rename(target)
        return True


def _fingerprint(objects: list[Entry]) -> str:
    lines = [f"{each.path}\n{each.size} {each.modified.isoformat()}" for each in objects]
    return hashlib.sha256("\n".join(sorted(lines)).encode()).hexdigest()
