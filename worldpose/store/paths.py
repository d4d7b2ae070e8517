"""Paths in a project, relative to its root."""

from __future__ import annotations

from dataclasses import dataclass

from pydantic import TypeAdapter, ValidationError

from data_contracts.operations import QueuedRun
from data_contracts.records import Key, Name, UnitName
from data_contracts.work import Work
from worldpose.errors import InputError

PROJECT = "project.json"
MANIFEST = "manifest.json"
STAGING = "staging"
DAMAGED = ".damaged"

_NAME: TypeAdapter[str] = TypeAdapter(Name)
_UNIT: TypeAdapter[str] = TypeAdapter(UnitName)
_KEY: TypeAdapter[str] = TypeAdapter(Key)


@dataclass(frozen=True, order=True)
class ResultId:
    """Identifier of a result: match, stage, unit and key. Every part is safe as a folder's name."""

    match_id: str
    stage: str
    unit: str
    key: str

    def __post_init__(self) -> None:
        for name in (self.match_id, self.stage):
            checked_name(name)
        try:
            _UNIT.validate_python(self.unit)
        except ValidationError as error:
            raise _bad_name("unit of a result", "1 to 129", self.unit) from error
        try:
            _KEY.validate_python(self.key)
        except ValidationError as error:
            raise InputError(
                "key of a result",
                expected="32 lower-case hexadecimal digits",
                found=repr(self.key),
                todo="Take the key from a run record or from recipe_key(recipe).",
            ) from error

    @classmethod
    def for_work(cls, work: Work) -> ResultId:
        """Return the result that `work` computes."""
        recipe = work.recipe
        return cls(recipe.match_id, recipe.stage, recipe.unit, work.key)

    @classmethod
    def from_name(cls, match_id: str, name: str, key: str) -> ResultId:
        """Return the result of the unit `name`, such as `tracking/clip`."""
        stage, _, unit = name.partition("/")
        return cls(match_id, stage, unit, key)

    @classmethod
    def from_path(cls, path: str) -> ResultId | None:
        """Return the result that contains the file at `path`, None if there is none."""
        parts = path.split("/")
        if len(parts) < 6 or parts[0] != "results":
            return None
        try:
            return cls(*parts[1:5])
        except InputError:
            return None

    @property
    def name(self) -> str:
        """Stage and unit: `tracking/clip`."""
        return f"{self.stage}/{self.unit}"

    @property
    def path(self) -> str:
        """The result's group."""
        return f"results/{self.match_id}/{self.stage}/{self.unit}/{self.key}"

    @property
    def manifest_path(self) -> str:
        """The file whose creation publishes the result."""
        return f"{self.path}/{MANIFEST}"


def registration_path(match_id: str) -> str:
    """Return the path of a match's registration."""
    return f"matches/{checked_name(match_id)}.json"


def record_path(match_id: str, run_id: str) -> str:
    """Return the path of a finished run's record."""
    return f"runs/{checked_name(match_id)}/{checked_name(run_id)}.json"


def summary_path(match_id: str) -> str:
    """Return the path of a match's summary, which is derived and may be deleted."""
    return f"summaries/{checked_name(match_id)}.json"


def reservation_path(match_id: str, run_id: str) -> str:
    """Return the path of a run number's reservation, valid until there is a record."""
    return f"runs/{checked_name(match_id)}/{checked_name(run_id)}.open.json"


def damaged_path(path: str) -> str:
    """Return the path where `repair` sets the damaged record at `path` aside, without readers."""
    return f"{path}{DAMAGED}"


def is_name(text: str) -> bool:
    """Return whether `text` is valid as the name of a match, stage, unit, run or pin."""
    try:
        checked_name(text)
    except InputError:
        return False
    return True


def pin_path(match_id: str, name: str) -> str:
    """Return the path of a pin."""
    return f"pins/{checked_name(match_id)}/{checked_name(name)}.json"


def queue_folder(run: QueuedRun) -> str:
    """Return the folder of the states of a run: that of its flow, and in it of its match."""
    folder = f"queue/{checked_name(run.flow)}"
    return f"{folder}/{checked_name(run.match_id)}" if run.match_id else folder


def queue_path(run: QueuedRun) -> str:
    """Return the path of one state of a run."""
    return f"{queue_folder(run)}/{run.id}.{run.number:04d}.json"


def checked_name(name: str) -> str:
    """Return `name`; InputError if it is not safe as a file name."""
    try:
        return _NAME.validate_python(name)
    except ValidationError as error:
        raise _bad_name("name of a match, stage, unit, run or pin", "1 to 64", name) from error


def _bad_name(where: str, length: str, name: str) -> InputError:
    return InputError(
        where,
        expected=f"{length} letters, digits, '.', '_' or '-', the first a letter or digit",
        found=repr(name),
        todo="Choose a name of these characters, such as final-2022.",
    )


def checked_path(path: str) -> str:
    """Return `path` if it stays inside the project on every file system and object store.

    InputError if it is absolute or empty, or has `..`, `.`, an empty part, a NUL, a line break or a
    backslash.
    """
    parts = path.split("/")
    if any(part in ("", ".", "..") for part in parts) or set(path) & set("\0\n\r\\"):
        raise InputError(
            "path inside a project",
            expected="a relative path of plain parts between '/'",
            found=repr(path),
            todo="Remove '..', '.', empty parts, backslashes and control characters.",
        )
    return path
