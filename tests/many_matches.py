"""A project with many matches, all copies of one that was run, and a season of queued runs."""

import json
import os
import re
import shutil
import uuid
from datetime import UTC, datetime, timedelta
from pathlib import Path

from data_contracts.operations import QueuedRun
from data_contracts.run import ResultManifest, RunRecord
from flows.method import unit_order
from worldpose.ingest.match_folder import read_match
from worldpose.ingest.registration import register_match
from worldpose.store.documents import seal
from worldpose.store.paths import queue_path
from worldpose.store.recipes import recipe_key
from worldpose.store.store import Store

SCAN_MINUTES = 15.0


def copy_match(project, match_id, count):
    """Add copies of a match to a project: folders, registrations, results and run records.

    Each copy has another pitch file, and so its own identity and keys. Arrays, images and poses
    are links to those of the match; there is no truth.
    """
    store = Store.open(str(project))
    folder = Path(store.registration(match_id).folder)
    before = store.registration(match_id).digest_of("pitch.json")
    for number in range(count):
        name = f"{match_id}-copy{number:03d}"
        hidden = shutil.ignore_patterns("reference", "match.yaml", "pitch.json")
        other = Path(project).parent / "copies" / name
        shutil.copytree(folder, other, ignore=hidden, copy_function=os.link)
        spec = (folder / "match.yaml").read_text()
        (other / "match.yaml").write_text(spec.replace(match_id, name))
        pitch = (folder / "pitch.json").read_text()
        (other / "pitch.json").write_text(f"{pitch}{' ' * (number + 1)}\n")  # its own digest
        for file in ("match.yaml", "pitch.json"):
            os.utime(other / file, (1e9, 1e9))  # a file that has just changed is read again later
        registration = register_match(read_match(other), None)
        store.register(registration)
        swapped = {before: registration.digest_of("pitch.json")}
        copy_results(Path(project), match_id, name, swapped)


def copy_results(project, match_id, name, swapped):
    """Copy run records and results; a key depends on the match, its pitch and earlier keys."""
    found = (project / "results" / match_id).rglob("manifest.json")
    for file in sorted(found, key=lambda it: unit_order("/".join(it.parts[-4:-2]))):
        manifest = renamed(ResultManifest, file.read_text(), match_id, name, swapped)
        key = swapped[file.parent.name] = recipe_key(manifest.recipe)
        place = file.parent.parent.relative_to(project / "results" / match_id)
        result = project / "results" / name / place / key
        result.mkdir(parents=True)
        for each in file.parent.iterdir():
            if each != file:
                (result / each.name).symlink_to(each.resolve())
        write(result / "manifest.json", manifest.model_copy(update={"key": key}))
    for file in (project / "runs" / match_id).glob("*.json"):
        record = renamed(RunRecord, file.read_text(), match_id, name, swapped)
        write(project / "runs" / name / file.name, record)


def renamed(record, text, match_id, name, swapped):
    text = text.replace(f'"{match_id}"', f'"{name}"')
    text = re.sub("|".join(swapped), lambda found: swapped[found[0]], text)
    content = json.loads(text)
    if "checksum" not in record.model_fields:
        del content["checksum"]
    return record.model_validate(content)


def write(file, record):
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_bytes(seal(record))


def queue_history(project, failed, days):
    """Add failed runs, spread over the matches, and the days' scans of the inbox to the queue."""
    store, now = Store.open(str(project)), datetime.now(UTC)
    names = store.matches()
    scans = int(days * 1440.0 / SCAN_MINUTES)
    asked = [
        ("ingest", "", "complete", now - timedelta(minutes=SCAN_MINUTES * n))
        for n in range(1, scans)
    ]
    span = timedelta(days=days) / max(failed, 1)
    asked += [
        ("match", names[n % len(names)], "failed", now - timedelta(days=days) + span * n)
        for n in range(failed)
    ]
    found = []
    for flow, match_id, state, at in asked:
        run = QueuedRun(
            id=f"{at:%Y%m%dT%H%M%S}-{uuid.uuid4().hex[:12]}",
            flow=flow,
            name=f"{match_id or 'arrivals'}, {at:%d %b %H:%M:%S}",
            match_id=match_id,
            parameters={"match_id": match_id} if match_id else {},
            flow_run=str(uuid.uuid4()),
            asked_at=at,
            changed_at=at,
        )
        for number, kind in enumerate(("asked", "begun", state), 1):
            message = "made" if kind == "failed" else ""
            change = {"number": number, "state": kind, "message": message}
            write(Path(project) / queue_path(run), run.model_copy(update=change))
        found.append(run.model_copy(update=change))
    return found
