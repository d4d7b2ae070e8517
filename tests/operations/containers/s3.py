"""An S3 server at port 8333 that answers one request at a time.

S3 decides which of two writers of a new file was first; moto may let both be.
"""

import threading

from moto.server import DomainDispatcherApplication, create_backend_app
from werkzeug.serving import WSGIRequestHandler, run_simple

application = DomainDispatcherApplication(create_backend_app)
deciding = threading.Lock()


def answer(environment, start):
    with deciding:
        return list(application(environment, start))


WSGIRequestHandler.protocol_version = "HTTP/1.1"
run_simple("0.0.0.0", 8333, answer, threaded=True)
