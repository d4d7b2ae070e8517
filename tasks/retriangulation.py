"""Task of stage `retriangulation`: joints of one clip, triangulated by adjusted cameras."""

from __future__ import annotations

from data_contracts.retriangulation import RETRIANGULATION
from data_contracts.work import Work
from tasks.triangulation import load_triangulation_settings, write_joints
from tasks.unit import unit_task
from worldpose.store.store import Store


@unit_task
def retriangulation(work: Work) -> str:
    """Publish joints with covariance; return the key."""
    store = Store.open(work.project)
    with store.publish(work) as result:
        settings = load_triangulation_settings(store, work.recipe, work.recipe.unit)
        write_joints(store, work, settings, result, RETRIANGULATION)
    return work.key
