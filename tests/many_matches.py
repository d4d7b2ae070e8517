"""A project with many matches, all copies of one that was run: only what lists of matches read."""

import json
import os
import shutil
from pathlib import Path

from data_contracts.run import ResultManifest, RunRecord
from worldpose.ingest.match_folder import read_match
from worldpose.ingest.registration import register_match
from worldpose.store.documents import seal
from worldpose.store.recipes import recipe_key
from worldpose.store.store import Store


def copy_match(project, match_id, count):
    """Add copies of a match to a project: registrations, run records and manifests of results.

    The copies have the folders, runs and metrics of the match, and none of its arrays.
    """
    store = Store.open(str(project))
    folder = Path(store.registration(match_id).folder)
    for number in range(count):
        name = f"{match_id}-copy{number:03d}"
        hidden = shutil.ignore_patterns("reference")
        other = Path(shutil.copytree(folder, folder.with_name(name), ignore=hidden))
        spec = (other / "match.yaml").read_text()
        (other / "match.yaml").write_text(spec.replace(match_id, name))
        pitch = json.loads((other / "pitch.json").read_text())
        (other / "pitch.json").write_text(json.dumps(pitch, indent=number + 1))  # its own digest
        for file in ("match.yaml", "pitch.json"):
            os.utime(other / file, (1e9, 1e9))  # a file that has just changed is read again later
        store.register(register_match(read_match(other), None))
        copy_results(Path(project), match_id, name)


def copy_results(project, match_id, name):
    """Copy run records and manifests; a result's key depends on the match."""
    keys = {}
    for file in (project / "results" / match_id).rglob("manifest.json"):
        manifest = renamed(ResultManifest, file.read_text(), match_id, name)
        key = keys[file.parent.name] = recipe_key(manifest.recipe)
        place = file.parent.parent.relative_to(project / "results" / match_id)
        write(
            project / "results" / name / place / key / "manifest.json",
            manifest.model_copy(update={"key": key}),
        )
    for file in (project / "runs" / match_id).glob("*.json"):
        text = file.read_text()
        for before, key in keys.items():
            text = text.replace(before, key)
        write(project / "runs" / name / file.name, renamed(RunRecord, text, match_id, name))


def renamed(record, text, match_id, name):
    content = json.loads(text.replace(f'"{match_id}"', f'"{name}"'))
    if "checksum" not in record.model_fields:
        del content["checksum"]
    return record.model_validate(content)


def write(file, record):
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_bytes(seal(record))
