"""Log lines and events of a worker that serves runs with a Prefect server each."""

import subprocess
import sys

SCRIPT = """
import threading, time
from prefect.context import TaskRunContext
from prefect.events.worker import EventsWorker
from prefect.settings import PREFECT_API_URL, temporary_settings
from tasks.unit import MAX_SERVERS, send_to_own_server

def log_senders():
    return sum(each.name == "APILogWorkerThread" for each in threading.enumerate())

with TaskRunContext.model_construct():
    for number in range(3 * MAX_SERVERS):
        address = f"http://127.0.0.1:{9 + number}/api"  # nothing listens there
        with temporary_settings({PREFECT_API_URL: address}):
            send_to_own_server()
            assert EventsWorker._client_override[1][0] == ("api_url", address)
deadline = time.monotonic() + 60
while log_senders() > MAX_SERVERS and time.monotonic() < deadline:
    time.sleep(0.1)
print(log_senders())
"""


def test_a_worker_sends_to_the_server_of_its_run_and_keeps_few_connections():
    done = subprocess.run(
        [sys.executable, "-c", SCRIPT], capture_output=True, text=True, check=True, timeout=120
    )
    assert done.stdout.strip() == "4"
