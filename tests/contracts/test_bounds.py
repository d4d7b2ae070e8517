"""Every number that a person or a file states has a smallest and a largest value."""

import importlib
import pkgutil
import typing

import annotated_types

import data_contracts
import worldpose
from data_contracts.records import Record

MEASURED = {"figures"}
"""Fields with whatever was measured, in any unit; nothing reads them back to compute."""
VERSION = {"contract"}


def stated_records():
    """Yield every record of `data_contracts`, and all settings of the library."""
    names = [m.name for m in pkgutil.walk_packages(data_contracts.__path__, "data_contracts.")]
    found = pkgutil.walk_packages(worldpose.__path__, "worldpose.", onerror=lambda _: None)
    names += [m.name for m in found if m.name.endswith("settings")]
    for name in sorted(names):
        module = importlib.import_module(name)
        for value in vars(module).values():
            if isinstance(value, type) and issubclass(value, Record) and value.__module__ == name:
                yield value


def unbounded(annotation, metadata):
    """Return whether a number within an annotation lacks a lower or an upper bound."""
    origin = typing.get_origin(annotation)
    if origin is typing.Annotated:
        inner, *own = typing.get_args(annotation)
        return unbounded(inner, [*metadata, *own])
    if annotation in (int, float):
        rules = list(annotated_rules(metadata))
        low = any(isinstance(rule, annotated_types.Ge | annotated_types.Gt) for rule in rules)
        high = any(isinstance(rule, annotated_types.Le | annotated_types.Lt) for rule in rules)
        return not (low and high)
    if origin is typing.Literal:
        return False
    return any(unbounded(each, metadata) for each in typing.get_args(annotation))


def annotated_rules(metadata):
    for rule in metadata:
        if hasattr(rule, "metadata"):
            yield from annotated_rules(rule.metadata)
        elif isinstance(rule, annotated_types.GroupedMetadata):
            yield from rule
        else:
            yield rule


def test_every_number_that_is_stated_has_both_bounds():
    records = list(stated_records())
    assert len(records) > 80
    lacking = [
        f"{record.__module__}.{record.__name__}.{name}"
        for record in records
        for name, field in record.model_fields.items()
        if name not in MEASURED | VERSION and unbounded(field.annotation, field.metadata)
    ]
    assert not lacking
