"""OpenLineage events of a run, made from the manifests of its results.

Each computed or failed unit is a run of the job `<match>.<stage>.<unit>`; each result is a dataset
with its key as version. Specification: https://openlineage.io/spec/2-0-2/OpenLineage.json.
"""

from __future__ import annotations

import functools
import json
import logging
import os
import uuid
from collections.abc import Iterator
from datetime import datetime, timedelta
from importlib.metadata import version
from pathlib import Path
from typing import Any, Final
from urllib.parse import unquote, urlsplit

import httpx

from data_contracts.run import RunRecord
from worldpose.store.store import Run, Store

LOG: Final = logging.getLogger("worldpose.run")
URL: Final = "OPENLINEAGE_URL"
"""Variable of OpenLineage's clients: `https://HOST`, or `file:///PATH` for a file of JSON lines."""
SCHEMA: Final = "https://openlineage.io/spec/2-0-2/OpenLineage.json#/$defs/RunEvent"
FACETS: Final = "https://openlineage.io/spec/facets"
ANSWER_SECONDS: Final = 5.0
"""Timeout of the receiver: a run waits for it once at most."""


def tell_lineage(store: Store, record: RunRecord) -> None:
    """Send the events of a recorded run to OPENLINEAGE_URL, if set; a failure is logged alone."""
    address = os.environ.get(URL)
    if not address:
        return
    try:
        events = [json.dumps(each) for each in lineage_events(store, record)]
        parts = urlsplit(address)
        if parts.scheme == "file":
            with Path(unquote(parts.path)).open("a", encoding="utf-8") as file:
                file.write("".join(f"{event}\n" for event in events))
            return
        endpoint = os.environ.get("OPENLINEAGE_ENDPOINT", "api/v1/lineage")
        headers = {"content-type": "application/json"}
        if key := os.environ.get("OPENLINEAGE_API_KEY"):
            headers["authorization"] = f"Bearer {key}"
        with httpx.Client(headers=headers, timeout=ANSWER_SECONDS) as client:  # one connection
            for event in events:
                answer = client.post(f"{address.rstrip('/')}/{endpoint.lstrip('/')}", content=event)
                answer.raise_for_status()
    except (OSError, httpx.HTTPError, httpx.InvalidURL) as error:
        LOG.warning("%s took not all lineage of %s: %s", URL, record.match_id, error)


def lineage_events(store: Store, record: RunRecord) -> Iterator[dict[str, Any]]:
    """Yield a START and a COMPLETE or FAIL event for each unit that a run computed or failed."""
    for name in record.executed:
        manifest = Run(store, record).manifest(name)
        end = manifest.created_at
        start = end - timedelta(seconds=manifest.seconds)
        used = manifest.recipe.inputs.items()
        inputs = [_dataset(store, record, name_of_input, key) for name_of_input, key in used]
        # A file or value of the match folder, without its place: it may move.
        inputs += [
            {"namespace": "worldpose.match", "name": f"{record.match_id}/{source}"}
            for source in sorted(manifest.recipe.sources)
        ]
        outputs = [_dataset(store, record, name, manifest.key)]
        yield {**_event(store, record, name, "START", start), "inputs": inputs}
        event = _event(store, record, name, "COMPLETE", end)
        yield {**event, "inputs": inputs, "outputs": outputs}
    for failure in record.failed:
        facet = {
            "message": failure.message,
            "programmingLanguage": "Python",
            **_facet("1-0-1/ErrorMessageRunFacet"),
        }
        yield _event(store, record, failure.unit, "START", record.started_at)
        event = _event(store, record, failure.unit, "FAIL", record.finished_at)
        event["run"]["facets"]["errorMessage"] = facet
        yield event


def _event(store: Store, record: RunRecord, unit: str, kind: str, at: datetime) -> dict[str, Any]:
    namespace = os.environ.get("OPENLINEAGE_NAMESPACE", "worldpose")
    run = f"{store.url} {record.match_id} {record.run_id}"
    job = f"{record.match_id}.{unit.replace('/', '.')}"
    parent = {
        "run": {"runId": _uuid(run)},
        "job": {"namespace": namespace, "name": record.match_id},
        **_facet("1-0-1/ParentRunFacet"),
    }
    return {
        "eventType": kind,
        "eventTime": at.isoformat(),
        "run": {"runId": _uuid(f"{run} {unit}"), "facets": {"parent": parent}},
        "job": {"namespace": namespace, "name": job},
        "producer": _producer(),
        "schemaURL": SCHEMA,
    }


def _dataset(store: Store, record: RunRecord, unit: str, key: str) -> dict[str, Any]:
    facet = {"datasetVersion": key, **_facet("1-0-1/DatasetVersionDatasetFacet")}
    namespace = store.url if "://" in store.url else f"file://{store.url}"
    name = f"results/{record.match_id}/{unit}"
    return {"namespace": namespace, "name": name, "facets": {"version": facet}}


def _facet(name: str) -> dict[str, str]:
    at, _, kind = name.partition("/")
    return {"_producer": _producer(), "_schemaURL": f"{FACETS}/{at}/{kind}.json#/$defs/{kind}"}


@functools.cache
def _producer() -> str:
    return f"urn:worldpose:{version('worldpose')}"


def _uuid(name: str) -> str:
    return str(uuid.uuid5(uuid.NAMESPACE_URL, name))
