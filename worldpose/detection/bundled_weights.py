"""Weights of the embedded nets as safetensors files: names, shapes and numbers, no code."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Final, TypeVar

from worldpose.errors import InputError

if TYPE_CHECKING:
    from torch import nn

Net = TypeVar("Net", bound="nn.Module")

FORMAT: Final = "worldpose-net"
"""Key of a file's metadata that names the class of the net."""


def save_weights(path: Path, net: nn.Module, about: dict[str, str] | None = None) -> None:
    """Write a net's weights atomically; equal weights give equal bytes.

    Args:
        path: an existing file is replaced.
        net: one of `worldpose.detection.bundled_nets`.
        about: further metadata, such as the origin of the weights.
    """
    from safetensors.torch import save

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

    Raises:
        InputError: no safetensors file, weights of another net, or numbers that are not finite.
    """
    import torch
    from safetensors import SafetensorError, safe_open

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
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
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
