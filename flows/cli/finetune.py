"""Commands label and finetune: train the embedded nets on corrected labels."""

from __future__ import annotations

import logging
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Final, get_args

import typer
from pydantic import JsonValue, ValidationError

from data_contracts.finetune import NetKind, NetVersion
from flows.cli import console
from flows.cli.options import DEFAULT_PROJECT
from flows.settings import parse_value
from worldpose.errors import UsageError, unknown_name

if TYPE_CHECKING:
    from worldpose.training.settings import FineTuningSettings

NETS: Final[tuple[NetKind, ...]] = get_args(NetKind)
SETTING = {"people": "detection.detector", "keypoints": "detection.pose"}
"""Setting that selects each net in a run."""


def label(
    videos: Annotated[list[Path], typer.Argument(metavar="VIDEO...")],
    out: Path,
    every: Annotated[int, typer.Option(min=1)] = 50,
    detectors: Annotated[list[str] | None, typer.Option("--detector")] = None,
    pose: str = "embedded",
) -> None:
    """Propose labels for evenly spaced frames, for people to correct.

    Example: worldpose label cam00.mp4 cam01.mp4 --out labels

    Options:
        videos: Videos of one size.
        out: Output folder; absent or empty.
        every: Step between labelled frames.
        detectors: Value of detection.detector; repeated for an ensemble.
        pose: Value of detection.pose.
    """
    from worldpose.detection.settings import DetectionSettings
    from worldpose.training.labels import propose_labels

    settings = DetectionSettings(detector=tuple(detectors or ["embedded"]), pose=pose)
    frames = propose_labels(videos, every, out, settings)
    told = f"proposed labels of {frames} frames: correct {out / 'labels.json'}"
    console.answer({"frames": frames, "labels": str(out / "labels.json")}, told)


def finetune(
    annotations: Annotated[Path, typer.Argument(metavar="LABELS")],
    pictures: Path | None = None,
    nets: Annotated[list[str] | None, typer.Option("--net")] = None,
    starts: Annotated[list[str] | None, typer.Option("--start", metavar="NET=FILE")] = None,
    assignments: Annotated[list[str] | None, typer.Option("--set", metavar="NAME=VALUE")] = None,
    project: str = DEFAULT_PROJECT,
) -> None:
    """Train nets on labels; adopt a version only if it is better on held-out frames.

    Example: worldpose finetune labels/labels.json --project worldpose-data

    Options:
        annotations: Reviewed labels: COCO keypoints, a JSON file.
        pictures: Folder of the images; that of LABELS by default.
        nets: people or keypoints; both by default.
        starts: Initial weights; the shipped ones by default.
        assignments: A setting, such as training.steps=800.
    """
    from flows.orchestration.prefect_environment import prefect_server

    if "://" in project:
        raise UsageError(
            f"--project {project}",
            expected="a folder",
            found="a URL",
            todo="Train in a local project: settings name weights by file.",
        )
    kinds = tuple(_kind(name, "--net") for name in nets or NETS)
    begin = _initial_weights(starts or [], kinds)
    settings = _settings(assignments or [])
    logger = logging.getLogger("worldpose.finetune")
    logger.setLevel(logging.INFO)
    shown = logging.StreamHandler()
    logger.addHandler(shown)
    try:
        with prefect_server() as wait_until_ready:
            from prefect.logging.handlers import APILogHandler

            from flows.finetune import FOLDER, fine_tune_nets

            wait_until_ready()
            try:
                versions = fine_tune_nets(
                    annotations, pictures, Path(project) / FOLDER, kinds, settings, begin
                )
            finally:
                APILogHandler().flush()  # while the server can still accept the last lines
    finally:
        logger.removeHandler(shown)
    folder = Path(project) / FOLDER
    console.print_json({"versions": [version.model_dump(mode="json") for version in versions]})
    _print(versions, folder)


def _print(versions: list[NetVersion], folder: Path) -> None:
    rows = (
        f"{v.net}\t{v.figure}\t{v.before:.3f}\t{v.after:.3f}\t{len(v.held_out)}\t"
        + ("adopted" if v.adopted else "not better: the old version stays")
        for v in versions
    )
    console.print_table("fine-tuning", "net\tmetric\t>before\t>after\t>held-out images\t", rows)
    chosen = [f"--set {SETTING[v.net]}=embedded:{folder / v.file}" for v in versions if v.adopted]
    if chosen:
        console.line(f"use it with: worldpose run MATCH {' '.join(chosen)}")


def _kind(name: str, where: str) -> NetKind:
    for kind in NETS:
        if name == kind:
            return kind
    raise unknown_name(f"{where} {name}", name, NETS)


def _initial_weights(starts: list[str], kinds: tuple[NetKind, ...]) -> dict[NetKind, Path]:
    """Return the files of `--start`, each of another trained net."""
    begin: dict[NetKind, Path] = {}
    for start in starts:
        name, file = _split_assignment(start)
        kind = _kind(name, "--start")
        if kind in begin or kind not in kinds:
            raise UsageError(
                f"--start {start}",
                expected=f"initial weights of each trained net once: {', '.join(kinds)}",
                found="the second of this net" if kind in begin else "a net that is not trained",
                todo="Leave it out, or name the net with --net.",
            )
        begin[kind] = Path(file)
    return begin


def _split_assignment(assignment: str) -> tuple[str, str]:
    name, equals, value = assignment.partition("=")
    if not equals:
        raise UsageError(
            assignment, expected="NAME=VALUE", found="no =", todo="Write training.steps=800."
        )
    return name, value


def _settings(assignments: list[str]) -> FineTuningSettings:
    """Parse settings by name; those of the training have the prefix `training.`."""
    from worldpose.training.settings import FineTuningSettings

    groups: dict[str, dict[str, JsonValue]] = {"": {}, "training": {}}
    for assignment in assignments:
        name, text = _split_assignment(assignment)
        group, _, field = name.rpartition(".")
        groups.setdefault(group, {})[field] = parse_value(text)
    given = groups.pop("")
    for group, fields in groups.items():
        whole = given.get(group, {})
        # The contract refuses what is no mapping.
        given[group] = {**whole, **fields} if isinstance(whole, dict) else whole
    try:
        return FineTuningSettings.model_validate(given)
    except ValidationError as error:
        first = error.errors()[0]
        raise UsageError(
            f"--set {'.'.join(map(str, first['loc']))}",
            expected=first["msg"],
            found=repr(first["input"]),
            todo="Use a setting of FineTuningSettings.",
        ) from None
