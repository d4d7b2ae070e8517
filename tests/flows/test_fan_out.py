"""Units on workers: those with a tag first, and many small ones together."""

import math

import pytest
from distributed import Client, LocalCluster, Worker, get_worker

from flows.match import on_workers_with, task_count


def where(number):
    return get_worker().name


@pytest.fixture(scope="module")
def cluster():
    """A scheduler and two workers in this process, one of them with a tag."""
    specification = {
        "plain": {"cls": Worker, "options": {"nthreads": 1}},
        "tagged": {"cls": Worker, "options": {"nthreads": 1, "resources": {"GPU": 1}}},
    }
    kept = {"processes": False, "n_workers": 0, "dashboard_address": None}
    with LocalCluster(**kept) as cluster:
        cluster.worker_spec.update(specification)
        cluster.sync(cluster._correct_state)
        yield cluster


@pytest.mark.parametrize(
    ("tag", "places"),
    [("GPU", {"tagged"}), ("TPU", {"plain", "tagged"}), (None, {"plain", "tagged"})],
)
def test_work_goes_to_workers_with_the_tag_where_there_are_any(tag, places, cluster):
    with Client(cluster, set_as_default=False) as client:
        client.wait_for_workers(2)
        with on_workers_with(tag, client):
            asked = [client.submit(where, number, pure=False) for number in range(8)]
        assert set(client.gather(asked)) == places


@pytest.mark.parametrize(
    ("seconds", "workers", "tasks"),
    [
        (17 * [0.35], 1, 1),
        (17 * [0.8], 1, 3),
        (17 * [0.35], 4, 4),
        (3 * [0.35], 4, 3),
        (17 * [14.0], 1, 17),
        (16 * [0.35] + [math.inf], 1, 17),
        (9000 * [0.35], 1, 200),
        (500 * [math.inf], 2, 40),
        ([], 1, 0),
    ],
)
def test_short_or_many_units_share_tasks(seconds, workers, tasks):
    assert task_count(seconds, workers) == tasks
