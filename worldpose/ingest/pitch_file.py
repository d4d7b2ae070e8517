"""Which pitch a match folder has: surveyed, standard or none."""

from __future__ import annotations

from pathlib import Path
from typing import Final

from data_contracts.match import MatchSpec
from data_contracts.pitch import PitchSpec
from worldpose.errors import InputError
from worldpose.ingest.places import existing_file
from worldpose.ingest.text_files import read_json, read_yaml
from worldpose.ingest.validation import validate_record

NO_PITCH: Final = "none"
"""Value of `pitch` in match.yaml for footage without a pitch."""


def pitch_file(folder: Path, spec: MatchSpec) -> Path | None:
    """Where the surveyed pitch is written; None = no pitch, or the standard one.

    Raises:
        InputError: match.yaml names a pitch file that is not there or lies outside, or says that
            there is no pitch beside pitch.json.
    """
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
    """The surveyed or standard pitch of a match; None where it has none.

    Raises:
        InputError: as `pitch_file`, or the file is no pitch.
    """
    file = pitch_file(folder, spec)
    if spec.pitch == NO_PITCH:
        return None
    return PitchSpec() if file is None else validate_record(PitchSpec, read_json(file), str(file))


def refuse_unread_pitch(folder: Path) -> None:
    """Refuse to add pitch.json to a folder whose match.yaml names another pitch, or none.

    Raises:
        InputError: nothing would read the file.
    """
    file = folder / "match.yaml"
    content = read_yaml(file) if file.exists() else None
    named = content.get("pitch") if isinstance(content, dict) else None
    if named not in (None, "pitch.json"):
        raise _two_pitches(folder, str(named))


def _two_pitches(folder: Path, named: str) -> InputError:
    return InputError(
        f"{folder / 'match.yaml'}: pitch",
        expected=f"no `pitch: {named}` where pitch.json lies",
        found="both",
        todo="Take that line out if the world is the pitch's, or the file away.",
    )
