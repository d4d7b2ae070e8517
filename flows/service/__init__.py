"""Operations: a project served day and night.

Input: a project and an inbox folder. Output: a Prefect server with deployments, a worker, the
pages, figures for Prometheus and alerts; `flows.service.serving` starts them.
"""
