"""Operations: continuous processing of a project.

Input: a project and an inbox folder. Output: a Prefect server with deployments, a worker, the
pages, metrics for Prometheus and alerts; `flows.service.serving` starts them.
"""
