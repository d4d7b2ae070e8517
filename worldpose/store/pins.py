"""Pins: names of runs that garbage collection keeps."""

from __future__ import annotations

from data_contracts.pin import Pin
from worldpose.errors import InputError
from worldpose.store.blobs import Blobs
from worldpose.store.documents import seal, unseal_repairable
from worldpose.store.paths import is_name, pin_path


def pin_run(blobs: Blobs, pin: Pin) -> Pin:
    """Pin a run under a name; return the pin in force.

    Pinning the same run under the same name again changes nothing.

    Raises:
        InputError: the name is a number or `latest`, or is another run's.
    """
    if pin.name == "latest" or pin.name.isdigit():
        raise InputError(
            f"name of run {pin.run_id} of {pin.match_id}",
            expected="a name that is no run's number",
            found=repr(pin.name),
            todo="Choose one with a letter, such as v1.",
        )
    if blobs.put_new(pin_path(pin.match_id, pin.name), seal(pin)):
        return pin
    known = read_pin(blobs, pin.match_id, pin.name)
    if known is None or known.run_id != pin.run_id:
        raise InputError(
            f"name {pin.name} of a run of {pin.match_id}",
            expected="a name that no other run has",
            found="nothing any more" if known is None else f"run {known.run_id} under it",
            todo="Choose another, or unpin that run first.",
        )
    return known


def unpin_run(blobs: Blobs, match_id: str, name: str) -> Pin:
    """Remove a pin, so that its run can be forgotten; return it.

    Raises:
        InputError: there is no such name.
    """
    pin = read_pin(blobs, match_id, name)
    if pin is None:
        names = ", ".join(known.name for known in list_pins(blobs, match_id))
        raise InputError(
            f"pin {match_id}/{name}",
            expected=f"one of {names or '(none)'}",
            found="no such name",
            todo="List them with `worldpose status`.",
        )
    blobs.delete(pin_path(match_id, name))
    return pin


def read_pin(blobs: Blobs, match_id: str, name: str) -> Pin | None:
    """Return the pin of a name, None if no run has it."""
    path = pin_path(match_id, name)
    data = blobs.read(path)
    return None if data is None else unseal_repairable(Pin, data, f"{blobs.url}/{path}")


def list_pins(blobs: Blobs, match_id: str) -> tuple[Pin, ...]:
    """Return all pins of a match, sorted by name."""
    files = [entry.path.rpartition("/")[2] for entry in blobs.entries(f"pins/{match_id}")]
    names = [file.removesuffix(".json") for file in files if file.endswith(".json")]
    pins = (read_pin(blobs, match_id, name) for name in names if is_name(name))
    return tuple(pin for pin in pins if pin is not None)
