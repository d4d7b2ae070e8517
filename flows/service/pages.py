"""Pages of a served project: review pages and status page."""

from __future__ import annotations

import os

from flows.service.plan import ServePlan
from flows.web.access import access_for
from flows.web.serving import serve


def serve_pages(plan: ServePlan) -> None:
    """Serve until this process ends."""
    access = access_for(
        plan.host,
        token=os.environ.pop("WORLDPOSE_REVIEW_TOKEN"),  # hide it from runs that pages start
        names=plan.names,
        secure=plan.certificate is not None,
    )
    tls = None
    if plan.certificate is not None and plan.key is not None:
        tls = (plan.certificate, plan.key)
    serve(plan.project, access, host=plan.host, port=plan.pages_port, tls=tls)
