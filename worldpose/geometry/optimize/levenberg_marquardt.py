"""The Levenberg-Marquardt loop: trial steps, acceptance, damping and stopping rule.

A problem plugs in a function that returns the state after a damped step. It linearizes, and solves
its normal equations in their own structure: dense, block-banded, or with points eliminated. A loop
that is compiled as a whole applies the same rules: `is_better` and `next_damping`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Generic, NamedTuple, Protocol, TypeVar

import numpy as np

from worldpose.compiled import compile_kernel


class State(Protocol):
    """Parameters of a problem, with their cost."""

    @property
    def cost(self) -> float:
        """Cost to minimize; infinite or NaN outside the domain."""


S = TypeVar("S", bound=State)


class Damping(NamedTuple):
    """Course of the damping.

    Attributes:
        start: initial Marquardt damping [1].
        decrease: factor that divides the damping after an accepted step [1].
        lowest: lower limit [1].
        highest: the loop ends if a rejected step raises the damping beyond it [1].
        increase: factor on the damping after a rejected step [1].
    """

    start: float
    decrease: float
    lowest: float
    highest: float = np.inf
    increase: float = 8.0


@dataclass(frozen=True, eq=False)
class Minimum(Generic[S]):
    """State of minimum cost, and costs at the start and after every accepted step.

    So many steps were tried; `converged` is whether the stopping rule ended the loop.
    """

    state: S
    costs: tuple[float, ...]
    iterations: int
    converged: bool


@compile_kernel
def is_better(before: float, after: float) -> bool:
    """Return whether a step from one cost to another is accepted: one to NaN never is."""
    return after < before


@compile_kernel
def next_damping(damping: float, accepted: bool, course: Damping) -> float:
    """Return the damping after an accepted or a rejected step."""
    if accepted:
        return max(damping / course.decrease, course.lowest)
    return damping * course.increase


def minimize(
    state: S,
    step: Callable[[S, float], S],
    course: Damping,
    iterations: int,
    converged: Callable[[S, S], bool],
) -> Minimum[S]:
    """Return the state of minimum cost near a start of finite cost, in so many steps at most.

    `step` returns the state after a damped step from a state. `converged` tells from the states
    before and after a trial step, also a rejected one, whether the loop ends.
    """
    damping, costs, done, iteration = course.start, [state.cost], False, 0
    while iteration < iterations and not done and damping <= course.highest:
        iteration += 1
        trial = step(state, damping)
        done = converged(state, trial)
        accepted = is_better(state.cost, trial.cost)
        damping = next_damping(damping, accepted, course)
        if accepted:
            state = trial
            costs.append(state.cost)
    return Minimum(state, tuple(costs), iteration, done)
