"""The two small nets that ship with the project: a person detector and a keypoint estimator.

Needs torch; the rest of the package imports this module only on demand. Both nets are plain
residual pyramids of 3 x 3 convolutions, which CPUs compute fastest; they differ in their heads.
Their weights are safetensors files: names, shapes and numbers, no code. On a CPU the shipped nets
compute in 8-bit integers, from ONNX files that infra/embedded_detector/quantize.py writes.
"""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path
from typing import Final, NamedTuple, TypeVar

import numpy as np
import torch
from numpy.typing import NDArray
from safetensors import SafetensorError, safe_open
from safetensors.torch import save
from torch import Tensor, nn
from torch.nn import functional

from data_contracts.arrays import Floats, Singles
from data_contracts.conventions import COCO17
from worldpose.compiled import compile_kernel
from worldpose.detection.crops import MAP_COUNT
from worldpose.detection.sampling import borrow
from worldpose.errors import InputError

Net = TypeVar("Net", bound=nn.Module)

STRIDE: Final = 4
"""Pixels of the frame per cell of the people map [px]."""
COARSEST: Final = 32
"""Frames are padded to multiples of this [px]."""
CELL: Final = 2
"""Pixels of the crop per cell of the keypoint maps [px]."""
GREY_MEAN: Final = 115.0
GREY_SPREAD: Final = 58.0
"""Mean and standard deviation of grey levels, by which images are normalized [of 255]."""
FORMAT: Final = "worldpose-net"
"""Key of a file's metadata that names the class of the net."""


class Block(nn.Sequential):
    """Convolution, batch normalisation and ReLU."""

    def __init__(self, inputs: int, outputs: int, kernel: int = 3, stride: int = 1) -> None:
        padding = (kernel - stride + 1) // 2 if kernel > 1 else 0
        super().__init__(
            nn.Conv2d(inputs, outputs, kernel, stride, padding, bias=False),
            nn.BatchNorm2d(outputs),
            nn.ReLU(inplace=True),
        )


class Residual(nn.Module):
    """Two convolutions with an identity shortcut."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.first, self.second = Block(width, width), Block(width, width)

    def forward(self, features: Tensor) -> Tensor:
        """Return features (batch, width, height, width) of the same shape."""
        changed: Tensor = self.second(self.first(features))
        return features + changed


class Pyramid(nn.Module):
    """Features of the finest map, with the context of all coarser ones.

    `stem` are layers from the image to the finest map. Of each map, half the size of the one before
    it, `widths` are the channels, and `depths` the residual blocks.
    """

    def __init__(self, stem: nn.Module, widths: Sequence[int], depths: Sequence[int]) -> None:
        super().__init__()
        self.stem = stem
        stages, laterals, merged = [], [], []
        for index, (width, depth) in enumerate(zip(widths, depths, strict=True)):
            down = [Block(widths[index - 1], width, stride=2)] if index else []
            stages.append(nn.Sequential(*down, *(Residual(width) for _ in range(depth))))
        for fine, coarse in pairwise(widths):
            laterals.append(nn.Conv2d(coarse, fine, 1, bias=False))
            merged.append(Block(fine, fine))
        self.stages, self.laterals = nn.ModuleList(stages), nn.ModuleList(laterals)
        self.merged = nn.ModuleList(merged)

    def forward(self, image: Tensor, added: Tensor | None = None) -> tuple[Tensor, Tensor]:
        """Return the finest and the coarsest map; `added` is added to the output of the stem."""
        stem = self.stem(image)
        maps = [self.stages[0](stem if added is None else stem + added)]
        for stage in self.stages[1:]:
            maps.append(stage(maps[-1]))
        features = maps[-1]
        for index in reversed(range(len(self.laterals))):
            above = functional.interpolate(self.laterals[index](features), scale_factor=2.0)
            features = self.merged[index](maps[index] + above)
        return features, maps[-1]


class PeopleNet(nn.Module):
    """Net for the centres of people and the distances to the sides of their boxes."""

    def __init__(self) -> None:
        super().__init__()
        self.pyramid = Pyramid(Block(3, 24, kernel=6, stride=4), (24, 40, 80, 128), (1, 2, 2, 1))
        last = nn.Conv2d(32, 5, 1)
        # Few cells are a person's centre: training begins from a probability of 1 %.
        last.bias = nn.Parameter(torch.tensor([-4.6, 0.0, 0.0, 0.0, 0.0]))
        self.head = nn.Sequential(Block(24, 32), last)

    def forward(self, images: Tensor) -> tuple[Tensor, Tensor]:
        """Return the maps of images (batch, 3, height, width) from `normalize`.

        Sides are multiples of `COARSEST`. Maps are logits that a cell is a person's centre (batch,
        rows, columns), and distances from there to left, top, right and bottom (batch, 4, rows,
        columns) [px].
        """
        features, _ = self.pyramid(images)
        maps = self.head(features).float()
        # Distance of a box side of logarithm 0 from its cell [px]: that of a person of about 60 px.
        return maps[:, 0], 16.0 * torch.exp(maps[:, 1:].clamp(-4.0, 4.0))


class Seen(NamedTuple):
    """Output of the keypoint net for crops.

    Attributes:
        maps: logits of each joint's position (batch, 17, rows, columns).
        doubt: logit of each joint from the crop as a whole (batch, 17).
        boxes: x0, y0, x1, y1 of the person (batch, 4) [px of the crop].
        fit: logits of the intersection over union of these and the true boxes (batch,).
        trust: weight of the mass of each joint's peak in its confidence (17,).
    """

    maps: Tensor
    doubt: Tensor
    boxes: Tensor
    fit: Tensor
    trust: Tensor

    def sureness(self, mass: Tensor) -> Tensor:
        """Return logits that joints are correct, from the crop and the mass of their peaks.

        The mass is (batch, 17) or, for several positions each, (batch, 17, places).
        """
        places = (1,) * (mass.ndim - 2)
        trusted = self.trust.view((-1, *places)) * torch.logit(mass, eps=1e-4)
        return self.doubt.view((*self.doubt.shape, *places)) + trusted


class KeypointNet(nn.Module):
    """Net for the 17 joints and the box of the person in a crop, with their confidences."""

    def __init__(self) -> None:
        super().__init__()
        stem = nn.Sequential(Block(3, 16, stride=2), Block(16, 32, stride=2))
        self.pyramid = Pyramid(stem, (32, 64, 128), (2, 2, 2))
        self.around = nn.Conv2d(MAP_COUNT, 32, 3, padding=1, bias=False)
        nn.init.zeros_(self.around.weight)
        self.head = nn.Sequential(Block(32, 64), nn.Conv2d(64, 4 * len(COCO17), 1))
        self.doubt = nn.Linear(128, len(COCO17))
        self.trust = nn.Parameter(torch.ones(len(COCO17)))
        self.outline = nn.Sequential(Block(32, 32), nn.Conv2d(32, 4, 1))
        self.fit = nn.Sequential(nn.Linear(128 + 4, 32), nn.ReLU(), nn.Linear(32, 1))

    def forward(self, crops: Tensor, surroundings: Tensor) -> Seen:
        """Return the net's output for crops (batch, 3, height, width) from `normalize`.

        `surroundings` (batch, 3, rows, columns) are maps of the target box and its neighbours.
        """
        features, coarsest = self.pyramid(crops, self.around(surroundings))
        maps = functional.pixel_shuffle(self.head(features), CELL)
        # The confidence of a joint must not change the features that find it.
        whole = coarsest.float().mean(dim=(2, 3))
        boxes, spread = edges(self.outline(features).float())
        fit = self.fit(torch.cat([whole, spread], dim=1))[:, 0]
        return Seen(maps.float(), self.doubt(whole.detach()), boxes, fit, self.trust)


def normalize(images: Tensor) -> Tensor:
    """Return images (batch, height, width, 3) of bytes as the nets take them (batch, 3, ...)."""
    return images.permute(0, 3, 1, 2).float().sub_(GREY_MEAN).div_(GREY_SPREAD)


def peaks(maps: Tensor) -> tuple[Tensor, Tensor]:
    """Return positions (batch, joints, 2) [px of the crop] and mass (batch, joints) of joints.

    The position is finer than a cell: the mean over the 5 x 5 cells around the likeliest one of
    logits (batch, joints, rows, columns). The mass is the probability there.
    """
    columns = maps.shape[-1]
    chance = functional.softmax(maps.flatten(2), dim=-1).view(-1, *maps.shape[2:])
    best = chance.flatten(1).argmax(dim=1)
    cells = torch.arange(len(best), device=maps.device), best // columns, best % columns
    places, mass = _means(chance, cells)
    return places.view(*maps.shape[:2], 2), mass.view(maps.shape[:2])


def edges(maps: Tensor) -> tuple[Tensor, Tensor]:
    """Return the edges of a box and the standard deviations of their probabilities.

    Each map, of logits (batch, 4, rows, columns) of left, top, right and bottom, is reduced to one
    axis: an edge's probability over columns or rows. Both are (batch, 4) [px of the crop, cells].
    """
    places, spreads = [], []
    edge_cell = 4  # Pixels of the crop per cell of the edge maps [px].
    for side in range(4):
        logits = torch.logsumexp(maps[:, side], dim=1 + side % 2)
        chance = functional.softmax(logits, dim=1)
        cell = torch.arange(chance.shape[1], device=maps.device, dtype=maps.dtype)
        place = chance @ cell
        places.append(edge_cell * place + 0.5 * (edge_cell - 1))
        spreads.append(((chance @ cell.square()) - place.square()).clamp(min=1e-6).sqrt())
    return torch.stack(places, dim=1), torch.stack(spreads, dim=1)


def decode_boxes(maps: Sequence[tuple[Tensor, ...]], least: float) -> Tensor:
    """Return people as rows of the index of the image, box [px] and score (people, 6).

    Images of some sizes have logits (batch, rows, columns) that a cell is a person's centre.
    Distances (batch, 4, rows, columns) are from there to left, top, right and bottom [px]. `least`
    is the lowest score reported.
    """
    limit, first, found = math.log(least / (1.0 - least)), 0, list[Tensor]()
    for logits, sides in maps:
        if logits.is_cpu:
            score, side = (each.contiguous().numpy() for each in (logits, sides))  # one kernel
            rows = torch.from_numpy(_find_boxes(score, side, np.flatnonzero(score >= limit)))
        else:
            high = functional.max_pool2d(logits, 3, stride=1, padding=1)
            image, row, column = torch.nonzero((logits == high) & (logits >= limit), as_tuple=True)
            left, top, right, bottom = sides[image, :, row, column].unbind(dim=1)
            x, y = (STRIDE * at + 0.5 * (STRIDE - 1) for at in (column, row))
            each = (image, x - left, y - top, x + right, y + bottom, logits[image, row, column])
            rows = torch.stack([one.double() for one in each], dim=1)
        rows[:, 0] += first
        first += len(logits)
        found.append(rows)
    people = torch.cat(found)
    people[:, 5].sigmoid_()
    return people


@compile_kernel
def _find_boxes(logits: Singles, sides: Singles, cells: NDArray[np.intp]) -> Floats:
    """Return the rows of `decode_boxes` of one map, with logits for scores, at flat `cells`."""
    height, width = logits.shape[1:]
    found, count = np.empty((len(cells), 6)), 0
    for cell in cells:
        image, place = divmod(cell, height * width)
        row, column = divmod(place, width)
        near = logits[image, max(row - 1, 0) : row + 2, max(column - 1, 0) : column + 2]
        if logits[image, row, column] == near.max():
            found[count, 0], found[count, 5] = image, logits[image, row, column]
            for axis, at in enumerate((column, row)):
                middle = np.float32(STRIDE * at + 0.5 * (STRIDE - 1))
                found[count, 1 + axis] = middle - sides[image, axis, row, column]
                found[count, 3 + axis] = middle + sides[image, 2 + axis, row, column]
            count += 1
    return found[:count]


def _means(chance: Tensor, cells: Sequence[Tensor]) -> tuple[Tensor, Tensor]:
    """Return mean positions (cells, 2) [px of the crop] and mass of the 5 x 5 cells around cells.

    Cells are the index of a map of probabilities (maps, rows, columns), row and column.
    """
    step = torch.arange(-2, 3, device=chance.device)
    index, row, column = (each[:, None, None] for each in cells)
    y, x = row + step[:, None], column + step
    inside = [at.clamp(0, count - 1) for at, count in zip((y, x), chance.shape[1:], strict=True)]
    near = chance[index, inside[0], inside[1]] * ((inside[0] == y) & (inside[1] == x))
    mass = near.sum(dim=(1, 2))
    x = cells[2] + (near * step).sum(dim=(1, 2)) / mass
    y = cells[1] + (near * step[:, None]).sum(dim=(1, 2)) / mass
    return CELL * torch.stack([x, y], dim=1) + 0.5 * (CELL - 1), mass


def decode_candidates(maps: Tensor, count: int) -> tuple[Tensor, Tensor]:
    """Return candidate positions of each joint, finer than cells, the likeliest first.

    Positions are the means over the 5 x 5 cells around the peaks of a map, the highest cells within
    three cells of them. Logits are (batch, joints, rows, columns), rows and columns multiples of
    four. Returned are positions (batch, joints, count, 2) [px of the crop] and the probability
    around each (batch, joints, count). It is 0 where a map has fewer peaks with a probability of
    0.01.
    """
    shape, flat = maps.shape[:2], maps.flatten(0, 1)
    # Candidate positions of less probability are dropped, except the likeliest of a joint [1].
    least = 0.01 / 25.0
    if maps.is_cpu:
        given = borrow("chance", flat.shape, np.float32)
        torch.softmax(flat.flatten(1), dim=1, out=torch.from_numpy(given).flatten(1))
        places, masses = map(torch.from_numpy, _find_candidates(given, count, np.float32(least)))
    else:
        chance = torch.softmax(flat.flatten(1), dim=1).view_as(flat)
        # As in the kernel, of equal cells in a block of 4 x 4 the first is the peak.
        high, at = (each.flatten(1) for each in functional.max_pool2d_with_indices(chance, (4, 4)))
        near = functional.max_pool2d(chance, 7, stride=1, padding=3).flatten(1).gather(1, at)
        peak = (high == near) & (high >= high.amax(dim=1, keepdim=True).clamp(max=least))
        cell, width = at[peak], maps.shape[-1]
        cells = (torch.nonzero(peak)[:, 0], cell // width, cell % width)
        at, mass = _means(chance, cells)
        order = torch.argsort(mass, descending=True, stable=True)
        order = order[torch.argsort(cells[0][order], stable=True)]
        index = cells[0][order]
        rank = torch.arange(len(order), device=maps.device) - torch.searchsorted(index, index)
        order, index, rank = order[rank < count], index[rank < count], rank[rank < count]
        places, masses = (maps.new_zeros(len(flat), count, *each) for each in ((2,), ()))
        places[index, rank], masses[index, rank] = at[order], mass[order]
    return places.view(*shape, count, 2), masses.view(*shape, count)


@compile_kernel
def _find_candidates(chance: Singles, count: int, least: np.float32) -> tuple[Singles, Singles]:
    """Return positions (maps, count, 2) and masses (maps, count) of maps of probabilities."""
    number, height, width = chance.shape
    places = np.zeros((number, count, 2), dtype=np.float32)
    masses = np.zeros((number, count), dtype=np.float32)
    four = np.empty(width, dtype=np.float32)
    high = np.empty((height // 4, width // 4), dtype=np.float32)
    for k in range(number):
        # Two peaks never share one of the blocks of 4 x 4 cells, and few of these are likely.
        for y in range(height // 4):
            rows = chance[k, 4 * y : 4 * y + 4]
            for x in range(width):
                four[x] = max(max(rows[0, x], rows[1, x]), max(rows[2, x], rows[3, x]))
            for x in range(width // 4):
                left, right = (
                    max(four[4 * x], four[4 * x + 1]),
                    max(four[4 * x + 2], four[4 * x + 3]),
                )
                high[y, x] = max(left, right)
        limit = min(least, high.max())
        for block in np.flatnonzero(high >= limit):
            y, x = divmod(block, width // 4)
            cell = chance[k, 4 * y : 4 * y + 4, 4 * x : 4 * x + 4].argmax()
            row, column = 4 * y + cell // 4, 4 * x + cell % 4
            near = chance[k, max(row - 3, 0) : row + 4, max(column - 3, 0) : column + 4]
            if chance[k, row, column] < near.max():
                continue
            total = right = below = 0.0
            for i in range(max(row - 2, 0), min(row + 3, height)):
                for j in range(max(column - 2, 0), min(column + 3, width)):
                    total += chance[k, i, j]
                    right += chance[k, i, j] * j
                    below += chance[k, i, j] * i
            mass, rank = np.float32(total), 0
            while rank < count and masses[k, rank] >= mass:
                rank += 1
            if rank < count:
                masses[k, rank + 1 :] = masses[k, rank:-1].copy()
                places[k, rank + 1 :] = places[k, rank:-1].copy()
                masses[k, rank] = mass
                places[k, rank, 0] = CELL * right / total + 0.5 * (CELL - 1)
                places[k, rank, 1] = CELL * below / total + 0.5 * (CELL - 1)
    return places, masses


def save_weights(path: Path, net: nn.Module, about: dict[str, str] | None = None) -> None:
    """Write a net's weights, with metadata `about`, atomically; equal weights give equal bytes."""
    tensors = {name: value.detach().contiguous() for name, value in net.state_dict().items()}
    data = save(tensors, {**(about or {}), FORMAT: type(net).__name__})
    # The library orders metadata at random.
    length = int.from_bytes(data[:8], "little")
    header = json.loads(data[8 : 8 + length])
    header["__metadata__"] = dict(sorted(header["__metadata__"].items()))
    written = json.dumps(header, separators=(",", ":"), ensure_ascii=False).encode()
    written = written.ljust(-(-len(written) // 8) * 8)
    data = len(written).to_bytes(8, "little") + written + data[8 + length :]
    draft = path.with_suffix(".part")
    draft.write_bytes(data)
    draft.replace(path)


def load_weights(path: Path, net: Net) -> Net:
    """Return `net` with the weights of a file, in evaluation mode.

    InputError for no safetensors file, weights of another net, or numbers that are not finite.
    """

    def refusal(found: str) -> InputError:
        return InputError(
            str(path),
            expected=f"weights of {type(net).__name__} as a safetensors file",
            found=found,
            todo="Name a file that worldpose has written, or leave it out for the shipped weights.",
        )

    if not path.is_file():
        raise refusal("no file")
    try:
        with safe_open(path, framework="pt") as file:
            kind = (file.metadata() or {}).get(FORMAT)
            if kind != type(net).__name__:
                raise refusal(f"weights of {kind}" if kind else "weights of something else")
            names = file.keys()
            tensors = {name: file.get_tensor(name) for name in names}
    except (SafetensorError, OSError) as error:
        raise refusal(f"a file that cannot be read ({error})") from error
    wanted = {name: tuple(value.shape) for name, value in net.state_dict().items()}
    given = {name: tuple(value.shape) for name, value in tensors.items()}
    if wanted != given:
        odd = sorted(name for name, _ in wanted.items() ^ given.items())
        raise refusal(f"other names or shapes: {', '.join(odd[:3])}")
    if not all(bool(torch.isfinite(value).all()) for value in tensors.values()):
        raise refusal("numbers that are not finite")
    net.load_state_dict(tensors)
    return net.eval()
