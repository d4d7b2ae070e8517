"""Reader of a match folder's pitch: surveyed, standard or none."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Final, TypeGuard

from pydantic import ValidationError

from data_contracts.conventions import OTHER_UNITS
from data_contracts.match import MatchSpec
from data_contracts.pitch import PitchSpec
from worldpose.errors import InputError
from worldpose.formats.files import read_json, read_yaml
from worldpose.ingest.validation import existing_file, validate_record
from worldpose.pitch.laws import prescribed_points
from worldpose.pitch.template import PitchTemplate

NO_PITCH: Final = "none"
"""Value of `pitch` in match.yaml for footage without a pitch."""


def pitch_file(folder: Path, spec: MatchSpec) -> Path | None:
    """Return the file of the surveyed pitch, or None; InputError if match.yaml contradicts it."""
    if spec.pitch == NO_PITCH:
        if (folder / "pitch.json").exists():
            raise _two_pitches(folder, NO_PITCH)
        return None
    if spec.pitch is not None:
        return existing_file(folder, spec.pitch, f"{folder / 'match.yaml'}: pitch")
    if not (folder / "pitch.json").exists():
        return None
    return existing_file(folder, "pitch.json", str(folder))


def read_pitch(folder: Path, spec: MatchSpec) -> PitchSpec | None:
    """Return the surveyed or standard pitch, None without a pitch; InputError if it is invalid."""
    file = pitch_file(folder, spec)
    if spec.pitch == NO_PITCH:
        return None
    if file is None:
        return PitchSpec()
    content = read_json(file)
    if isinstance(content, dict) and content.get("any_size") is not True:
        usual = _read_keys(content, ("template",))
        if usual is not None:
            _check_size(content, usual, str(file))
        sized = _read_keys(content, ("template", "length", "width", "dimensions"))
        if sized is not None:
            _check_points(content.get("points"), sized, str(file))
    pitch = validate_record(PitchSpec, content, str(file))
    PitchTemplate.from_spec(pitch, where=str(file))
    return pitch


def _read_keys(content: Mapping[str, object], keys: Sequence[str]) -> PitchSpec | None:
    """Return the pitch of these keys alone; None where the contract says what is wrong."""
    try:
        return PitchSpec.model_validate({key: content[key] for key in keys if key in content})
    except ValidationError:
        return None


def _check_size(content: Mapping[str, object], usual: PitchSpec, file: str) -> None:
    """Raise InputError for an implausible size of the pitch [m], with a guess of its unit."""
    allowed = {"length": (80.0, 130.0), "width": (40.0, 100.0)}  # [m], of football
    allowed_shares = (0.6, 1.5)  # of another game, relative to its template's [1]
    for key in allowed:
        value, nominal = content.get(key), float(getattr(usual, key))
        if not _is_number(value) or value <= 0:
            continue  # the contract says what is wrong with it
        least, most = allowed_shares[0] * nominal, allowed_shares[1] * nominal
        if usual.template == "football":
            least, most = allowed[key]
        if not least <= value <= most:
            units = [u for u, metres in OTHER_UNITS.items() if least <= value * metres <= most]
            guess = f", which looks like {units[0]}" if units else ""
            expected = f"{least:g} to {most:g} metres"
            todo = (
                "Give all lengths and points in metres, name the game as template, or add "
                '"any_size": true where the pitch is of another size.'
            )
            raise InputError(f"{file}: {key}", expected, f"{value:g}{guess}", todo)


def _check_points(points: object, pitch: PitchSpec, file: str) -> None:
    """Raise InputError, naming the farthest one, for surveyed points far from their places."""
    from_laws = 2.0  # maximum distance of a surveyed point from its place in the rules, in plan [m]
    if not isinstance(points, dict):
        return  # the contract says what is wrong with them
    laws = prescribed_points(pitch)
    off = {
        name: math.dist(place[:2], laws[name][:2])
        for name, place in points.items()
        if name in laws and isinstance(place, list) and all(map(_is_number, place[:2]))
        if len(place) > 1
    }
    worst = max(off, key=lambda name: off[name], default=None)
    if worst is None or off[worst] <= from_laws:
        return
    x, y = (float(value) for value in points[worst][:2])
    units = [
        name
        for name, metres in OTHER_UNITS.items()
        if math.dist((x * metres, y * metres), laws[worst][:2]) <= from_laws
    ]
    guess = f", which looks like {units[0]}" if units else ""
    raise InputError(
        f"{file}: points.{worst}",
        expected=f"a place within {from_laws:g} m of the {pitch.template} rules': "
        f"{laws[worst][0]:.2f}, "
        f"{laws[worst][1]:.2f} m on a pitch of {pitch.length:g} x {pitch.width:g} m",
        found=f"{x:g}, {y:g}{guess}",
        todo="Correct the name, the place, or length and width; the origin is the centre spot, x "
        'runs along the touch line. "any_size": true switches this check off.',
    )


def _is_number(value: object) -> TypeGuard[float]:
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)


def require_free_pitch(folder: Path, runs: Sequence[str] = ()) -> None:
    """Raise InputError if pitch.json must not be written.

    That is if match.yaml names another pitch, or none, or `runs` (MATCH/NUMBER) had its pitch.
    """
    file = folder / "match.yaml"
    content = read_yaml(file) if file.exists() else None
    named = content.get("pitch") if isinstance(content, dict) else None
    if named not in (None, "pitch.json"):
        raise _two_pitches(folder, str(named))
    if runs:
        raise InputError(
            str(folder / "pitch.json"),
            expected="no run yet: another pitch, or a point more on it, makes another match",
            found=f"{', '.join(runs)}; nothing was written",
            todo="Copy the folder, give the copy a new match_id in match.yaml, and import there; "
            f"or forget the runs: worldpose gc --delete --forget {' --forget '.join(runs)}",
        )


def _two_pitches(folder: Path, named: str) -> InputError:
    expected = f"no `pitch: {named}` where pitch.json lies"
    todo = "Take that line out if the world is the pitch's, or the file away."
    return InputError(f"{folder / 'match.yaml'}: pitch", expected, "both", todo)
