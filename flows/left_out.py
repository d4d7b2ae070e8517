"""Static cameras that a run leaves out, and the warnings of a run.

One bad camera must not end a run: every later stage is planned as if the match did not have it. A
stage that may leave cameras out has `Stage.leaves_out`, stands before `tracking` in `METHOD`, and
fills `ResultWriter.left_out` with the reasons. The arrays of its result must tell the same, because
two computations of one key are compared by them. With gates, a person is asked first.

With fewer than two cameras, `tracking` and all later stages have no results: the run is partial.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial

from flows.stage import Match, Stage
from worldpose.errors import StoreError
from worldpose.store.store import Store


def left_out_cameras(
    store: Store, match: Match, stages: tuple[Stage, ...], results: Mapping[str, str]
) -> dict[str, str]:
    """Return static cameras that published results leave out, with reasons, in match order."""
    judging = {stage.name for stage in stages if stage.leaves_out}
    said: dict[str, str] = {}
    for name, key in sorted(results.items()):
        stage, _, unit = name.partition("/")
        if stage in judging:
            place = (match.match_id, stage, unit, key)
            load = partial(store.manifest, match.match_id, stage, unit, key)
            try:
                said = {**match.once(place, load).left_out, **said}
            except StoreError:  # not computed yet, or damaged: then its reader reports it
                continue
    return {each.id: said[each.id] for each in match.folder.spec.static_cameras if each.id in said}


def left_out_warnings(match: Match, left_out: Mapping[str, str], needed: int) -> list[str]:
    """Return one sentence per camera, and one if fewer than `needed` cameras are left."""
    told = {camera: reason.rstrip(".") for camera, reason in left_out.items()}
    said = [f"camera {camera} is left out: {reason}." for camera, reason in told.items()]
    left = [each.id for each in match.without(left_out).folder.spec.static_cameras]
    if left_out and len(left) < needed:
        said.append(
            f"{len(left)} of {len(left) + len(left_out)} static cameras can be used"
            f"{' (' + ', '.join(left) + ')' if left else ''}, and {needed} are needed to place "
            "people: there are no tracks, joints or bodies."
        )
    return said
