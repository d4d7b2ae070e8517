"""Result of stage `retriangulation`: the arrays of `triangulation`, from adjusted cameras."""

from __future__ import annotations

from data_contracts.triangulation import TRIANGULATION

RETRIANGULATION = TRIANGULATION.model_copy(
    update={
        "stage": "retriangulation",
        "about": "3D joints of every person, triangulated again with the adjusted cameras.",
    }
)
