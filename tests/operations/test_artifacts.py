"""Display of a deployment's run at Prefect."""

import os

import pytest
from command_line import TINY
from prefect.client.orchestration import get_client
from prefect.client.schemas.filters import ArtifactFilter, ArtifactFilterKey
from prefect.settings import PREFECT_API_AUTH_STRING, PREFECT_API_URL, temporary_settings

from flows.progress import reporter
from flows.service.artifacts import show_at_prefect


@pytest.fixture
def artifact(server):
    """A function that gives the last artifact of a kind, and how many there are."""

    def read(key):
        wanted = ArtifactFilter(key=ArtifactFilterKey(any_=[key]))
        with get_client(sync_client=True) as client:
            found = client.read_artifacts(artifact_filter=wanted)
        assert len(found) == 1, key
        return found[0]

    # Prefect has read its settings when this file imported it, before the server was there.
    login = {PREFECT_API_AUTH_STRING: os.environ["PREFECT_API_AUTH_STRING"]}
    with temporary_settings({PREFECT_API_URL: server, **login}):
        yield read


def test_a_run_shows_its_progress(artifact):
    key = "tiny-3-1-2s"
    with show_at_prefect(TINY):
        reporter().run_planned({"tracking": 30.0, "body_fitting": 10.0})
        reporter().stage_started("tracking", "who is who", units=2, missing=2)
        reporter().unit_done("tracking/a", 1.0, {})
        shown = artifact(f"progress-{key}")
        assert shown.data == pytest.approx(37.5)
        assert shown.description.startswith("tracking/a, about ")
        reporter().unit_failed("tracking/b", "why")
        assert artifact(f"progress-{key}").data == pytest.approx(75.0)
    assert artifact(f"progress-{key}").data == 100.0
