"""Prefect's forms of our deployments: typed fields, and choices where there are any."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Final

from data_contracts.release import EXPORT_FORMATS
from flows.method import METHOD
from flows.service.match_runs import MatchRuns
from flows.service.plan import ServePlan, deployment_name

STAGES: Final = tuple(stage.name for stage in METHOD)
CHOICES: Final[Mapping[str, Sequence[str]]] = {
    "from_stage": STAGES,
    "until_stage": STAGES,
    "formats": tuple(EXPORT_FORMATS),
}
"""Parameter to the values of it, or of its items."""
OF_MATCHES: Final = ("match_id", "matches")
"""Parameters that name registered matches."""
WITH_MATCHES: Final = ("match", "release", "reprocess")
"""Flows that have one of them."""


def form_schema(schema: Mapping[str, Any], hidden: Sequence[str]) -> dict[str, Any]:
    """Return the schema of a flow's parameters for Prefect's form.

    A parameter that may be None, which the form would ask the type of, is one that may be left out.

    Args:
        schema: JSON schema as Prefect makes it from the flow.
        hidden: parameters that a run must not change.
    """
    fields = {
        name: _type_field(name, dict(field))
        for name, field in schema["properties"].items()
        if name not in hidden
    }
    required = [name for name in schema.get("required", ()) if name not in hidden]
    return {**schema, "properties": fields, "required": required}


def _type_field(name: str, field: dict[str, Any]) -> dict[str, Any]:
    kinds = [each for each in field.pop("anyOf", ()) if each.get("type") != "null"]
    if kinds:
        field = {**kinds[-1], **field}
    if field.get("default", "") is None:
        del field["default"]
    field["title"] = name.removesuffix("_id").replace("_", " ").capitalize()
    about = str(field.get("description", ""))
    field["description"] = about[:1].upper() + about[1:]
    return _offer(field, CHOICES[name]) if name in CHOICES else field


def _offer(field: Mapping[str, Any], choices: Sequence[str]) -> dict[str, Any]:
    """Return a field, or that of a list, with the values to choose from."""
    if field.get("type") == "array":
        items = {"type": "string", **({"enum": list(choices)} if choices else {})}
        return {**field, "items": items}
    free = {name: value for name, value in field.items() if name != "enum"}
    return {**free, "type": "string", **({"enum": list(choices)} if choices else {})}


def offered_matches(schema: Mapping[str, Any] | None) -> list[str]:
    """Return the matches that a form of a deployment offers."""
    fields = (schema or {}).get("properties", {})
    named = [fields[name] for name in OF_MATCHES if name in fields]
    return [match for field in named for match in field.get("items", field).get("enum", ())]


def offer(schema: Mapping[str, Any], matches: Sequence[str]) -> dict[str, Any]:
    """Return the schema of a form that offers the matches."""
    fields = dict(schema.get("properties", {}))
    choices = sorted(matches)
    fields |= {name: _offer(fields[name], choices) for name in OF_MATCHES if name in fields}
    return {**schema, "properties": fields}


def offer_matches(plan: ServePlan, matches: Sequence[str]) -> None:
    """Let the forms of the deployments offer the registered matches."""
    prefect = MatchRuns.of_plan(plan)
    for flow in WITH_MATCHES:
        found = prefect.deployment(deployment_name(plan.name, flow))
        if found is None:
            continue  # the worker installs it soon
        form = found["parameter_openapi_schema"] or {}
        changed = offer(form, matches)
        if changed != form:
            update = {"parameter_openapi_schema": changed}
            prefect.ask(f"/deployments/{found['id']}", update, method="PATCH")
