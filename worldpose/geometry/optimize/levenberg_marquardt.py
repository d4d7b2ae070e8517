"""The Levenberg-Marquardt loop: trial steps, acceptance, damping and stopping rule.

A problem plugs in a function that returns the state after a damped step. It linearizes, and solves
its normal equations in their own structure: dense, block-banded, or with points eliminated.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Generic, Protocol, TypeVar

import numpy as np


class State(Protocol):
    """Parameters of a problem, with their cost."""

    @property
    def cost(self) -> float:
        """Cost to minimize; infinite or NaN outside the domain."""


S = TypeVar("S", bound=State)


@dataclass(frozen=True)
class Schedule:
    """Course of the damping, and the stopping rule.

    Attributes:
        damping: initial Marquardt damping [1].
        decrease: factor that divides the damping after an accepted step [1].
        increase: factor on the damping after a rejected step [1].
        min_damping: lower limit [1].
        max_damping: the loop ends if a rejected step raises the damping beyond it [1].
        iterations: maximum number of steps, accepted or rejected.
        converged: whether the costs before and after a trial step end the loop; the loop asks for
            rejected steps, too.
    """

    damping: float
    decrease: float
    min_damping: float
    iterations: int
    converged: Callable[[float, float], bool]
    increase: float = 8.0
    max_damping: float = np.inf


@dataclass(frozen=True, eq=False)
class Minimum(Generic[S]):
    """Result of the loop.

    Attributes:
        state: state of minimum cost.
        costs: at the start and after every accepted step.
        iterations: number of steps tried.
        converged: whether the stopping rule ended the loop.
    """

    state: S
    costs: tuple[float, ...]
    iterations: int
    converged: bool


def minimize(state: S, step: Callable[[S, float], S], schedule: Schedule) -> Minimum[S]:
    """Return the state of minimum cost near a start.

    A step is accepted if it decreases the cost; one to a cost that is not finite never is.

    Args:
        state: the start, of finite cost.
        step: returns the state after a damped step from a state.
        schedule: damping and stopping rule.
    """
    damping, costs, done, iteration = schedule.damping, [state.cost], False, 0
    while iteration < schedule.iterations and not done:
        iteration += 1
        trial = step(state, damping)
        done = schedule.converged(state.cost, trial.cost)
        if trial.cost < state.cost:
            state = trial
            costs.append(state.cost)
            damping = max(damping / schedule.decrease, schedule.min_damping)
        else:
            damping *= schedule.increase
            if damping > schedule.max_damping:
                break
    return Minimum(state, tuple(costs), iteration, done)
