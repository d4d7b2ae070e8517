"""A project with many matches, all copies of one that was run: only what lists of matches read."""

import json
import os
import shutil
from pathlib import Path

from data_contracts.run import ResultManifest, RunRecord
from flows.registering import register
from worldpose.store import Store
from worldpose.store.documents import seal


def copy_match(project, match_id, count):
    """Add copies of a match to a project: registrations, run records and manifests of results.

    The copies have the folders, runs and metrics of the match, and none of its arrays.
    """
    store = Store.open(str(project))
    project = Path(project)
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
        register(store, other, unfinished=True)
        for kind, record in (("runs", RunRecord), ("results", ResultManifest)):
            for file in (project / kind / match_id).rglob("*.json"):
                if kind == "results" and file.name != "manifest.json":
                    continue
                content = json.loads(file.read_text().replace(f'"{match_id}"', f'"{name}"'))
                if "checksum" not in record.model_fields:
                    del content["checksum"]
                copied = project / kind / name / file.relative_to(project / kind / match_id)
                copied.parent.mkdir(parents=True, exist_ok=True)
                copied.write_bytes(seal(record.model_validate(content)))
