"""Project: content-addressed results, written atomically and never overwritten; opened runs."""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING

from data_contracts.match import Registration
from data_contracts.run import (
    BODY_STAGES,
    JOINT_STAGES,
    Project,
    Reservation,
    ResultManifest,
    RunRecord,
)
from data_contracts.work import Work
from worldpose.errors import CorruptionError, InputError, NondeterminismError, StoreError
from worldpose.store.blobs import Blobs, LocalBlobs, pass_commit_point
from worldpose.store.documents import seal, unseal, verify_published
from worldpose.store.paths import (
    MANIFEST,
    PROJECT,
    ResultId,
    is_name,
    record_path,
    registration_path,
    reservation_path,
)
from worldpose.store.recipes import STORE_FORMAT, recipe_key
from worldpose.store.runs import LATEST, begin_run, read_document, read_pin, run_files, run_order
from worldpose.store.writer import ResultWriter

if TYPE_CHECKING:
    import xarray as xr


class Store:
    """Results, runs and registered matches of one project.

    Results live at `results/<match>/<stage>/<unit>/<key>/`, each with a manifest written last.
    Safe for any number of concurrent processes: results need no lock, and none is overwritten.
    """

    def __init__(self, blobs: Blobs) -> None:
        self.blobs = blobs

    def __repr__(self) -> str:
        return f"Store({self.url!r})"

    @property
    def url(self) -> str:
        """The project's folder, or the address of its bucket and prefix."""
        return self.blobs.url

    @classmethod
    def create(cls, url: str | os.PathLike[str]) -> Store:
        """Open the project at `url`, or create it if it does not exist.

        InputError if that has another contract version, StoreError if it is not writable.
        """
        blobs = open_blobs(os.fspath(url))
        blobs.put_new(PROJECT, seal(Project(store_format=STORE_FORMAT)))
        return cls.open(url)

    @classmethod
    def open(cls, url: str | os.PathLike[str]) -> Store:
        """Open the project at `url`; InputError if it is none, or of another contract or format."""
        blobs = open_blobs(os.fspath(url))
        data = blobs.read(PROJECT)
        if data is None:
            raise InputError(
                f"no worldpose project at {blobs.url}",
                expected=PROJECT,
                found="no such file",
                todo=(
                    "Register a match, which also creates the project: worldpose ingest "
                    f"MATCH_FOLDER --project {os.fspath(url)}. An empty project: worldpose init "
                    f"{os.fspath(url)}"
                ),
            )
        where = f"{blobs.url}/{PROJECT}"
        project = unseal(Project, data, where)
        if project.store_format != STORE_FORMAT:
            raise InputError(
                f"{where}: store_format",
                expected=repr(STORE_FORMAT),
                found=repr(project.store_format),
                todo="Use the version of worldpose that made the project, or make a new project.",
            )
        return cls(blobs)

    @classmethod
    def open_or_new(cls, url: str | os.PathLike[str]) -> Store:
        """Open the project at `url` as `open`; if there is none, the first `register` creates it.

        Input can thus be validated first, and refused input leaves nothing behind.
        """
        blobs = open_blobs(os.fspath(url))
        return cls.open(url) if blobs.exists(PROJECT) else cls(blobs)

    def matches(self) -> tuple[str, ...]:
        """Return the ids of the registered matches, sorted."""
        paths = (entry.path for entry in self.blobs.entries("matches"))
        names = (path.removeprefix("matches/") for path in paths if path.endswith(".json"))
        # macOS and others put their own files on shares.
        return tuple(filter(is_name, (name.removesuffix(".json") for name in names)))

    def registration(self, match_id: str) -> Registration | None:
        """Return the registration of a match; None if it is not registered."""
        return read_document(self.blobs, registration_path(match_id), Registration)

    def register(self, registration: Registration) -> None:
        """Register a match or replace its registration."""
        match_id = registration.spec.match_id
        self.blobs.put_new(PROJECT, seal(Project(store_format=STORE_FORMAT)))
        if self.registration(match_id) != registration:
            self.blobs.put(registration_path(match_id), seal(registration))

    def has(self, match_id: str, stage: str, unit: str, key: str) -> bool:
        """Return whether this result is published."""
        return self.blobs.exists(ResultId(match_id, stage, unit, key).manifest_path)

    def results(self, match_id: str | None = None) -> tuple[ResultId, ...]:
        """Return all published results, of one match or of all, sorted."""
        top = "results" if match_id is None else f"results/{match_id}"
        found = ((entry.path, ResultId.from_path(entry.path)) for entry in self.blobs.entries(top))
        return tuple(
            sorted(result for path, result in found if result and path == result.manifest_path)
        )

    def manifest(self, match_id: str, stage: str, unit: str, key: str) -> ResultManifest:
        """Return the manifest of a published result, StoreError if it is not published.

        CorruptionError if the manifest is damaged, or belongs to another result.
        """
        result = ResultId(match_id, stage, unit, key)
        where = f"{self.url}/{result.manifest_path}"
        data = self.blobs.read(result.manifest_path)
        if data is None:
            raise StoreError(
                f"{where}: there is no such result. Run `worldpose run {match_id}` to compute it. "
                "`worldpose gc` removes leftovers of an interrupted run."
            )
        manifest = unseal(ResultManifest, data, where)
        recipe = manifest.recipe
        named = (recipe.match_id, recipe.stage, recipe.unit, recipe_key(recipe))
        if named != (match_id, stage, unit, key) or manifest.key != key:
            raise CorruptionError(
                f"{where} is the manifest of another result: {'/'.join(named)}.",
                "Run `worldpose verify --repair`.",
            )
        return manifest

    @contextmanager
    def publish(self, work: Work) -> Iterator[ResultWriter]:
        """Yield a writer whose result is published only when the block ends without an error.

        An error in the block leaves nothing behind; a killed process leaves only private staging.
        If the key is already published, equal content changes nothing, and other content raises
        NondeterminismError. InputError if the work's key does not match its recipe, StoreError if
        the disk is full or not writable.
        """
        if work.key != recipe_key(work.recipe):
            raise InputError(
                f"work on {work.recipe.name}",
                expected=f"key {recipe_key(work.recipe)} of its recipe",
                found=f"key {work.key}",
                todo="Compute the key with worldpose.store.recipes.recipe_key.",
            )
        folder = self.blobs.create_staging()
        try:
            writer = ResultWriter(work, folder)
            yield writer
            manifest = writer.sealed_manifest()
            pass_commit_point("before_publish")
            result = ResultId.for_work(work)
            if self.blobs.publish_tree(folder, result.path, MANIFEST, seal(manifest)):
                pass_commit_point("after_commit")
                writer.manifest = manifest
            else:
                writer.manifest = self._check_same_content(result, manifest)
        finally:
            shutil.rmtree(folder, ignore_errors=True)

    def open_result(
        self, match_id: str, stage: str, unit: str, key: str, verify: bool = False
    ) -> xr.Dataset:
        """Open a published result as labelled arrays, with units and conventions in the attributes.

        Values are read on access, and every byte is then verified against the manifest; with
        `verify`, every file is verified now. StoreError if the result is not published,
        CorruptionError if a file is missing or changed.
        """
        # Imported here: status and resumed runs need only manifests, and Zarr takes most of a
        # second.
        from worldpose.store.groups import PublishedFiles, read_group

        result = ResultId(match_id, stage, unit, key)
        manifest = self.manifest(match_id, stage, unit, key)
        if verify:
            for file in manifest.files:
                verify_published(self.blobs, result, file)
        data = read_group(PublishedFiles(self.blobs, result, manifest))
        data.attrs.update(match=match_id, unit=unit, key=key)
        return data

    def withdraw(self, result: ResultId) -> None:
        """Remove a result, manifest first, so that the next run recomputes it."""
        self.blobs.delete_tree(result.path, MANIFEST)

    def reserve_run(self, match_id: str) -> str:
        """Reserve a run number that no other run of the match has or gets: `0001`, `0002`, ..."""
        number = 0
        while True:
            # A record that was set aside keeps its number: reviews may name the run. A number that
            # could not be reserved, for any reason, is not tried again.
            taken = set[str]().union(*run_files(self.blobs, match_id))
            number = max([number, *(run_order(name)[0] for name in taken)]) + 1
            run_id = f"{number:04d}"
            path = reservation_path(match_id, run_id)
            if not self.blobs.put_new(path, seal(begin_run(match_id, run_id))):
                continue
            # Another run may have taken this number, finished and dropped its reservation since.
            if not self.blobs.exists(record_path(match_id, run_id)):
                return run_id
            self.blobs.delete(path)

    def finish_run(self, record: RunRecord) -> None:
        """Write the record of a run, once; StoreError if a result it names is not published."""
        results = [
            ResultId.from_name(record.match_id, name, key) for name, key in record.results.items()
        ]
        with ThreadPoolExecutor(8) as pool:
            published = pool.map(self.blobs.exists, (result.manifest_path for result in results))
            lost = [
                result.path for result, there in zip(results, published, strict=True) if not there
            ]
        if lost:
            raise StoreError(
                f"run {record.run_id} of match {record.match_id} names results that {self.url} "
                f"does not have: {', '.join(lost)}. Run `worldpose run {record.match_id}` again."
            )
        path, data = record_path(record.match_id, record.run_id), seal(record)
        pass_commit_point("before_run_record")
        if not self.blobs.put_new(path, data) and self.blobs.read(path) != data:
            raise StoreError(
                f"{self.url}/{path} exists with other content: run {record.run_id} of match "
                f"{record.match_id} was finished earlier. Reserve a new run."
            )
        pass_commit_point("after_run_record")
        self.blobs.delete(reservation_path(record.match_id, record.run_id))

    def runs(self, match_id: str) -> tuple[str, ...]:
        """Return the ids of a match's finished runs, first to last."""
        return tuple(sorted(run_files(self.blobs, match_id)[0], key=run_order))

    def unfinished_runs(self, match_id: str) -> tuple[Reservation, ...]:
        """Return a match's active and killed runs, first to last."""
        finished, reserved, _ = run_files(self.blobs, match_id)
        paths = (
            reservation_path(match_id, run_id)
            for run_id in sorted(reserved - finished, key=run_order)
        )
        found = (read_document(self.blobs, path, Reservation) for path in paths)
        return tuple(reservation for reservation in found if reservation)

    def run(self, match_id: str, run_id: str = LATEST) -> RunRecord:
        """Return the record of a finished run by number or name; `latest` has the highest number.

        InputError if there is none, CorruptionError if it is damaged.
        """
        finished, reserved, _ = run_files(self.blobs, match_id)
        names = sorted(finished, key=run_order)
        wanted = names[-1] if run_id == LATEST and names else run_id
        wanted = wanted.zfill(4) if wanted.isdecimal() else wanted
        if wanted not in finished:
            pin = read_pin(self.blobs, match_id, run_id)
            wanted = wanted if pin is None else pin.run_id
        record = None
        if wanted in finished:
            record = read_document(self.blobs, record_path(match_id, wanted), RunRecord)
        if record is None:
            raise InputError(
                f"run {run_id} of match {match_id} in {self.url}",
                expected=f"one of {', '.join(names)}" if names else "a finished run",
                found="an unfinished run" if wanted in reserved else "no such run",
                todo=f"List them: worldpose status {match_id}; or run: worldpose run {match_id}",
            )
        return record

    def _check_same_content(self, result: ResultId, ours: ResultManifest) -> ResultManifest:
        theirs = self.manifest(result.match_id, result.stage, result.unit, result.key)
        if theirs.content != ours.content:
            changed = sorted({file.path for file in {*theirs.files} ^ {*ours.files}})
            raise NondeterminismError(
                f"{self.url}/{result.path}: the published content differs from the content of this "
                f"computation in {len(changed)} files; the first is {changed[0]}. The same recipe "
                "must give the same bytes. The published result stays. Report the stage."
            )
        return theirs


class LateStore(Store):
    """The store of the project at `url`, which is opened at its first use."""

    def __init__(self, url: str) -> None:
        self._given = url

    @cached_property
    def blobs(self) -> Blobs:  # type: ignore[override]
        """Files of the project."""
        return Store.open(self._given).blobs


def open_blobs(url: str) -> Blobs:
    """Return the files at `url`: a folder, or `s3://bucket/prefix`; InputError for any other."""
    if url.startswith("s3://"):
        # Late: object storage is an extra, and needs obstore.
        from worldpose.store.objects import ObjectBlobs

        return ObjectBlobs.at(url)
    if "://" in url:
        raise InputError(
            f"project {url}",
            expected="a folder or s3://bucket/prefix",
            found=f"the scheme {url.split('://')[0]!r}",
            todo="Name a folder, or an S3-compatible store with AWS_ENDPOINT_URL set.",
        )
    return LocalBlobs(Path(url).expanduser().absolute())


class Run(Mapping[str, "xr.Dataset"]):
    """Results of one run: `run["triangulation/clip"].joints`, `run.bodies("clip").transl`.

    Each is opened on first access, and its values are read on access. Dimensions are labelled, and
    `time` is the time of each frame in seconds.
    """

    def __init__(self, store: Store, record: RunRecord) -> None:
        self.record = record
        """Record of the run: results, settings, metrics, versions, times."""
        self.store = store
        """Store that holds the results."""
        self._opened: dict[str, xr.Dataset] = {}

    def __getitem__(self, name: str) -> xr.Dataset:
        if name not in self.record.results:
            failures = {failure.unit: failure for failure in self.record.failed}
            if name in failures:
                why = f"it failed with {failures[name].error}: {failures[name].message}"
            elif name in self.record.blocked and self.record.waiting:
                why = f"{len(self.record.waiting)} results that it needs wait for review"
            else:
                why = f"the run has {', '.join(self) or 'no results'}"
            raise KeyError(f"run {self.record.run_id} has no result of {name!r}: {why}")
        if name not in self._opened:
            stage, _, unit = name.partition("/")
            result = self.store.open_result(
                self.record.match_id, stage, unit, self.record.results[name]
            )
            self._opened[name] = self._label(result)
        return self._opened[name]

    def manifest(self, name: str) -> ResultManifest:
        """Return how a result was computed: recipe, versions, metrics, warnings."""
        stage, _, unit = name.partition("/")
        return self.store.manifest(self.record.match_id, stage, unit, self.record.results[name])

    def bodies(self, clip: str) -> xr.Dataset:
        """Return the best bodies of a clip, refitted ones if the run has them; InputError if none.

        `run.bodies(clip).joints` are their keypoints; `.to_dataframe()` of any array gives pandas.
        """
        return self._best(clip, BODY_STAGES)

    def joints(self, clip: str) -> xr.Dataset:
        """Return the best result with `joints` and `covariance` of a clip, or InputError."""
        return self._best(clip, JOINT_STAGES)

    def _best(self, clip: str, stages: Sequence[str]) -> xr.Dataset:
        for stage in reversed(stages):
            if f"{stage}/{clip}" in self:
                return self[f"{stage}/{clip}"]
        clips = {name.partition("/")[2] for name in self if name.partition("/")[0] in stages}
        raise InputError(
            f"run {self.record.run_id} of match {self.record.match_id}: clip {clip}",
            expected=f"a result of {' or '.join(stages)}",
            found=f"results of {', '.join(sorted(clips))}" if clips else "none of any clip",
            todo=f"Name one of these clips, or run: worldpose run {self.record.match_id}",
        )

    def _label(self, result: xr.Dataset) -> xr.Dataset:
        """Add the time of every frame [s], and names of rotations and shape components."""
        from worldpose.body.keypoints import JOINT_NAMES  # late: status needs no body

        axes = ("x", "y", "z")
        shapes = list(range(result.sizes.get("shape_component", 0)))
        names: dict[str, Sequence[object]] = {
            "rotation": axes,
            "rotation_23": [f"{joint}_{axis}" for joint in JOINT_NAMES[1:] for axis in axes],
            "shape_component": shapes,
            "shape_component_": shapes,
        }
        labelled = result.assign_coords(
            {
                dim: list(values)
                for dim, values in names.items()
                if dim not in result.coords and result.sizes.get(dim) == len(values)
            }
        )
        registration = self.store.registration(self.record.match_id)
        if "frame" in result.coords and registration is not None:
            about = {"units": "s", "about": "time of the match frame: frame / frames per second"}
            seconds = result["frame"].values / registration.spec.fps
            labelled = labelled.assign_coords(time=("frame", seconds, about))
        return labelled

    def __iter__(self) -> Iterator[str]:
        return iter(sorted(self.record.results))

    def __len__(self) -> int:
        return len(self.record.results)

    def __contains__(self, name: object) -> bool:
        return name in self.record.results

    def __repr__(self) -> str:
        record = self.record
        title = f"Run {record.run_id} of match {record.match_id}: {record.state}"
        return "\n".join(
            [
                f"{title}, finished {record.finished_at:%Y-%m-%d %H:%M} UTC, {self.store.url}",
                *(f"  {name}  {record.results[name][:12]}" for name in self),
                *(f"  {failure.unit}  failed: {failure.error}" for failure in record.failed),
            ]
        )


def open_run(project: str | os.PathLike[str], match: str, run: str = LATEST) -> Run:
    """Open a match run's results as labelled arrays (xarray), metres and pixels, world frame.

    Args:
        project: the project's folder or `s3://bucket/prefix`.
        match: the match's id.
        run: the run's number, such as `0003`, or `latest`.

    Raises:
        InputError: there is no such project, match or run.
        CorruptionError: stored bytes differ from the published ones.
    """
    store = Store.open(project)
    return Run(store, store.run(match, run))
