"""Task of stage `retriangulation`: joints of one clip, triangulated by adjusted cameras."""

from __future__ import annotations

from data_contracts.retriangulation import RETRIANGULATION
from data_contracts.work import Work
from tasks.triangulation import place_joints, settings_before
from tasks.unit import unit_task
from worldpose.store import Store


@unit_task
def retriangulation(work: Work) -> str:
    """Publish joints with covariance; return the key."""
    store = Store.open(work.project)
    with store.publishing(work) as result:
        settings = settings_before(store, work, work.recipe.unit)
        place_joints(store, work, settings, result, RETRIANGULATION)
    return work.key
