"""MoveNet as ONNX, from the TFJS graph models of an npm package.

Needs tensorflow and tf2onnx, in a separate environment; afterwards onnxruntime alone runs the nets.
Example: python convert_movenet.py movenet-thunder.json thunder.onnx 256 256
"""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import tensorflow as tf
import tf2onnx
from google.protobuf import json_format
from tensorflow.core.framework import graph_pb2

PLAIN = {
    "_FusedConv2D": "Conv2D",
    "FusedDepthwiseConv2dNative": "DepthwiseConv2dNative",
    "_FusedMatMul": "MatMul",
}
"""Plain operations of the TFJS operations that are fused with bias and activation."""
KEPT = ("T", "strides", "padding", "data_format", "dilations", "transpose_a", "transpose_b")
"""Attributes of these."""


def read_weights(folder: Path, manifest: list[dict[str, Any]]) -> dict[str, np.ndarray]:
    """Return the constants by name; those stored as small integers are dequantized."""
    raw = b"".join((folder / path).read_bytes() for group in manifest for path in group["paths"])
    weights: dict[str, np.ndarray] = {}
    at = 0
    for entry in (entry for group in manifest for entry in group["weights"]):
        quantized = entry.get("quantization")
        stored = np.dtype(quantized["dtype"] if quantized else entry["dtype"])
        count = int(np.prod(entry["shape"]))
        values = np.frombuffer(raw, stored, count, at)
        at += values.nbytes
        if quantized and "scale" in quantized:
            values = values.astype(np.float32) * quantized["scale"] + quantized["min"]
        weights[entry["name"]] = values.astype(entry["dtype"]).reshape(entry["shape"])
    return weights


def plain_graph(graph: Any, weights: dict[str, np.ndarray]) -> Any:  # noqa: ANN401
    """Return the graph with its constants, with fused operations split into their chains."""
    out = graph_pb2.GraphDef()
    out.versions.CopyFrom(graph.versions)
    for node in graph.node:
        if node.op == "Const":
            values = weights[node.name]
            node.attr["value"].tensor.CopyFrom(tf.make_tensor_proto(values))
            node.attr["dtype"].type = tf.as_dtype(values.dtype).as_datatype_enum
        if node.op not in PLAIN:
            out.node.add().CopyFrom(node)
            continue
        chain = [name.decode() for name in node.attr["fused_ops"].list.s]
        names = [f"{node.name}/part{part}" for part in range(len(chain))] + [node.name]
        first = out.node.add(op=PLAIN[node.op], name=names[0], input=node.input[:2])
        for key in KEPT:
            if key in node.attr:
                first.attr[key].CopyFrom(node.attr[key])
        further = list(node.input[2:])
        for part, operation in enumerate(chain):
            given = [names[part]] + ([further.pop(0)] if operation == "BiasAdd" else [])
            step = out.node.add(op=operation, name=names[part + 1], input=given)
            step.attr["T"].CopyFrom(node.attr["T"])
    return out


def convert(model: Path, out: Path, height: int, width: int) -> None:
    """Write a TFJS graph model as ONNX, for one image of a fixed size."""
    content = json.loads(model.read_text())
    topology = {key: content["modelTopology"][key] for key in ("node", "versions")}
    graph = json_format.ParseDict(topology, graph_pb2.GraphDef(), ignore_unknown_fields=True)
    plain = plain_graph(graph, read_weights(model.parent, content["weightsManifest"]))
    inputs = [node for node in plain.node if node.op == "Placeholder"]
    for node in inputs:
        batch, rows, columns, _ = node.attr["shape"].shape.dim
        batch.size, rows.size, columns.size = 1, height, width
    used = {name.split(":")[0].lstrip("^") for node in plain.node for name in node.input}
    signature = content.get("signature", {}).get("outputs", {})
    outputs = [entry["name"] for entry in signature.values()] or [
        f"{node.name}:0"
        for node in plain.node
        if node.name not in used and node.op not in ("Const", "NoOp", "Placeholder")
    ]
    net, _ = tf2onnx.convert.from_graph_def(
        plain, input_names=[f"{node.name}:0" for node in inputs], output_names=outputs, opset=17
    )
    onnx.save(net, str(out))


if __name__ == "__main__":
    convert(Path(sys.argv[1]), Path(sys.argv[2]), int(sys.argv[3]), int(sys.argv[4]))
