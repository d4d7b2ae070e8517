"""Training of a net: seeded, checkpointed, resumable, with early stopping at the best weights.

Checks evaluate and keep the running mean of the weights (Polyak averaging), which is better at any
step than the weights of the step. The seed and the step's number alone determine the batch of a
step. So a training that was killed and resumes from its checkpoint gives the weights of an
uninterrupted one.
"""

from __future__ import annotations

import copy
import json
import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Final, Generic, TypeVar

import numpy as np
import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save
from torch import Tensor, nn

from worldpose.errors import InputError
from worldpose.training.settings import TrainingSettings

Net = TypeVar("Net", bound=nn.Module)
Batch = TypeVar("Batch")
Tensors = dict[str, Tensor]

WARM_UP: Final = 0.04
"""Share of the steps in which the learning rate rises to its full value [1]."""
LAST_RATE: Final = 0.02
"""Share of the full rate at the end [1]."""


@dataclass(frozen=True)
class Check:
    """Result of a check during training.

    Attributes:
        step: steps done.
        loss: mean since the previous check.
        figure: metric of the net on held-out frames; higher is better.
    """

    step: int
    loss: float
    figure: float


@dataclass(frozen=True, eq=False)
class _State:
    """State from which a training resumes."""

    mean: Tensors
    step: int = 0
    checks: tuple[Check, ...] = ()
    best: Tensors = field(default_factory=dict)
    losses: tuple[float, ...] = ()


@dataclass(frozen=True, eq=False)
class Training(Generic[Net, Batch]):
    """A net, its batches, loss and metric.

    Attributes:
        net: changed in place.
        batch: draws a batch.
        loss: of the net on a batch.
        figure: metric of the net on held-out frames; higher is better.
        settings: rate, steps and seed.
    """

    net: Net
    batch: Callable[[np.random.Generator], Batch]
    loss: Callable[[Net, Batch], Tensor]
    figure: Callable[[Net], float]
    settings: TrainingSettings


def train(
    training: Training[Net, Batch],
    checkpoint: Path | None = None,
    progress: Callable[[str], None] = lambda line: None,
) -> tuple[Check, ...]:
    """Train a net and return its checks; the net then has the weights of the best one.

    A check also runs before the first step: training that makes the net worse changes nothing.

    Args:
        training: net, batches, loss, metric and settings.
        checkpoint: written at every check; if the file exists, training resumes from it.
        progress: receives a line at every check.

    Raises:
        InputError: the checkpoint is of another training.
    """
    net, settings = training.net, training.settings
    optimizer = torch.optim.AdamW(net.parameters(), lr=settings.rate, weight_decay=settings.decay)
    state = _State(mean=_copied(net.state_dict()))
    if checkpoint is not None and checkpoint.is_file():
        state = _read(checkpoint, net, optimizer, settings)
        progress(f"goes on after step {state.step}")
    else:
        state = _checked(training, state)
    while state.step < settings.steps and not _settled(state, settings):
        loss = _step(training, optimizer, state.step)
        _blend(
            state.mean, net.state_dict(), min(settings.memory, (1 + state.step) / (10 + state.step))
        )
        state = replace(state, step=state.step + 1, losses=(*state.losses, loss))
        if state.step % settings.check_every == 0 or state.step == settings.steps:
            state = _checked(training, state)
            last = state.checks[-1]
            progress(
                f"step {last.step} of {settings.steps}: loss {last.loss:.4f}, "
                f"held-out figure {last.figure:.4f}"
            )
            if checkpoint is not None:
                _write(checkpoint, net, optimizer, state, settings)
    net.load_state_dict(state.best)
    net.eval()
    return state.checks


def _step(training: Training[Net, Batch], optimizer: torch.optim.Optimizer, step: int) -> float:
    settings = training.settings
    planned = settings.planned or settings.steps
    rising = min((step + 1) / max(WARM_UP * planned, 1.0), 1.0)
    done = min(step / planned, 1.0)
    falling = LAST_RATE + (1.0 - LAST_RATE) * 0.5 * (1.0 + math.cos(math.pi * done))
    for group in optimizer.param_groups:
        group["lr"] = settings.rate * rising * falling
    batch = training.batch(np.random.default_rng([settings.seed, step]))
    training.net.train()
    device = next(training.net.parameters()).device.type
    with torch.autocast(device, torch.bfloat16, enabled=settings.bfloat16):
        loss = training.loss(training.net, batch)
    optimizer.zero_grad(set_to_none=True)
    loss.backward()  # type: ignore[no-untyped-call]
    torch.nn.utils.clip_grad_norm_(training.net.parameters(), settings.clip)
    optimizer.step()
    return float(loss.detach())


def _checked(training: Training[Net, Batch], state: _State) -> _State:
    """Return the state after one more check."""
    mean = copy.deepcopy(training.net).eval()
    mean.load_state_dict(state.mean)
    figure = training.figure(mean)
    best = max((check.figure for check in state.checks), default=-math.inf)
    loss = float(np.mean(state.losses)) if state.losses else math.nan
    return replace(
        state,
        checks=(*state.checks, Check(state.step, loss, figure)),
        best=_copied(state.mean) if figure > best else state.best,
        losses=(),
    )


def _settled(state: _State, settings: TrainingSettings) -> bool:
    figures = [check.figure for check in state.checks]
    return len(figures) - 1 - figures.index(max(figures)) >= settings.patience


@torch.no_grad()
def _blend(mean: Tensors, now: Tensors, kept: float) -> None:
    """Move a running mean towards the current weights, in place; integers are copied."""
    for name, value in now.items():
        if value.is_floating_point():
            mean[name].lerp_(value, 1.0 - kept)
        else:
            mean[name].copy_(value)


def _copied(tensors: Tensors) -> Tensors:
    return {name: value.detach().clone().contiguous() for name, value in tensors.items()}


def _write(
    path: Path,
    net: nn.Module,
    optimizer: torch.optim.Optimizer,
    state: _State,
    settings: TrainingSettings,
) -> None:
    """Write a checkpoint atomically."""
    tensors = {f"net.{name}": value for name, value in _copied(net.state_dict()).items()}
    tensors |= {f"mean.{name}": value for name, value in state.mean.items()}
    tensors |= {f"best.{name}": value for name, value in _copied(state.best).items()}
    for number, moments in optimizer.state_dict()["state"].items():
        tensors |= {f"moment.{number}.{name}": value for name, value in _copied(moments).items()}
    about = {
        "settings": settings.model_dump_json(),
        "step": str(state.step),
        "checks": json.dumps([[c.step, c.loss, c.figure] for c in state.checks]),
    }
    draft = path.with_suffix(".part")
    draft.write_bytes(save(tensors, about))
    draft.replace(path)


def _read(
    path: Path, net: nn.Module, optimizer: torch.optim.Optimizer, settings: TrainingSettings
) -> _State:
    """Restore weights and moments of a checkpoint in place, and return its state.

    Raises:
        InputError: the file is no checkpoint, or that of another training.
    """

    def refusal(found: str) -> InputError:
        return InputError(
            str(path),
            expected="a checkpoint of this training",
            found=found,
            todo="Remove the file to begin anew, or train with the settings it was written with.",
        )

    try:
        with safe_open(path, framework="pt") as file:
            about = file.metadata() or {}
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
    except (SafetensorError, OSError) as error:
        raise refusal(f"a file that cannot be read ({error})") from error
    if about.get("settings") != settings.model_dump_json():
        raise refusal(f"settings {about.get('settings', 'of something else')}")
    parts: dict[str, Tensors] = {"net": {}, "mean": {}, "best": {}, "moment": {}}
    for name, value in tensors.items():
        kind, _, rest = name.partition(".")
        parts.setdefault(kind, {})[rest] = value
    moments: dict[int, Tensors] = {}
    for name, value in parts["moment"].items():
        number, _, moment = name.partition(".")
        moments.setdefault(int(number), {})[moment] = value
    try:
        net.load_state_dict(parts["net"])
        optimizer.load_state_dict({**optimizer.state_dict(), "state": moments})
        checks = tuple(Check(int(s), float(v), float(f)) for s, v, f in json.loads(about["checks"]))
        return _State(parts["mean"], int(about["step"]), checks, parts["best"])
    except (RuntimeError, ValueError, KeyError) as error:
        raise refusal(f"{type(error).__name__}: {error}") from error
