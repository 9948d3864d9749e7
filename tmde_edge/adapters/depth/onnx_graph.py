"""The first nodes of an ONNX file, read from its bytes: enough to see whether normalisation is part of the graph.

ONNX Runtime does not show nodes and the `onnx` package is no run-time dependency; the protobuf wire format is simple.
Field numbers: onnx.proto3 (ModelProto.graph = 7; GraphProto.node = 1; NodeProto.input = 1, output = 2, op_type = 4).
"""

from __future__ import annotations

import mmap
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from tmde_edge.errors import ModelError

_PASSING = frozenset(("QuantizeLinear", "DequantizeLinear", "Cast", "Identity", "Transpose"))


@dataclass(frozen=True, slots=True)
class Node:
    """One operator: its type and the names it reads and writes."""

    op: str
    inputs: tuple[str, ...]
    outputs: tuple[str, ...]


def first_operators(path: Path, input_name: str, count: int = 2) -> tuple[str, ...]:
    """Types of the first operators after the input, those that only pass values on left out. Raises ModelError."""
    operators: list[str] = []
    name = input_name
    for node in _nodes(path):
        if name in node.inputs and node.outputs:
            if node.op not in _PASSING:
                operators.append(node.op)
            name = node.outputs[0]
            if len(operators) >= count:
                break
    return tuple(operators)


def normalises_inside(path: Path, input_name: str) -> bool:
    """True where the graph itself subtracts a mean and divides by a deviation before anything else."""
    operators = first_operators(path, input_name)
    return len(operators) == 2 and operators[0] in ("Sub", "Add") and operators[1] in ("Div", "Mul")


def _nodes(path: Path) -> Iterator[Node]:
    try:
        with path.open("rb") as f, mmap.mmap(f.fileno(), 0, access=mmap.ACCESS_READ) as data:
            for field, start, end in _fields(data, 0, len(data)):
                if field == 7:
                    yield from _graph_nodes(data, start, end)
    except (IndexError, ValueError, UnicodeDecodeError) as e:
        raise ModelError(f"{path}: not an ONNX file ({e}); fetch it again with `tmde-edge models fetch`") from None
    except OSError as e:
        raise ModelError(f"{path}: cannot be read ({e.strerror}); check its permissions") from None


def _graph_nodes(data: mmap.mmap, start: int, end: int) -> Iterator[Node]:
    for field, node_start, node_end in _fields(data, start, end):
        if field != 1:
            continue
        op, inputs, outputs = "", [], []
        for part, a, b in _fields(data, node_start, node_end):
            if part in (1, 2, 4):
                text = data[a:b].decode("utf-8")
                if part == 1:
                    inputs.append(text)
                elif part == 2:
                    outputs.append(text)
                else:
                    op = text
        yield Node(op, tuple(inputs), tuple(outputs))


def _fields(data: mmap.mmap, start: int, end: int) -> Iterator[tuple[int, int, int]]:
    """(field number, start, end) of each length-delimited field; other wire types are skipped."""
    at = start
    while at < end:
        key, at = _varint(data, at, end)
        wire = key & 7
        if wire == 0:
            _, at = _varint(data, at, end)
        elif wire == 1:
            at += 8
        elif wire == 5:
            at += 4
        elif wire == 2:
            size, at = _varint(data, at, end)
            if at + size > end:
                raise ValueError("a field is longer than the file")
            yield key >> 3, at, at + size
            at += size
        else:
            raise ValueError(f"wire type {wire}")


def _varint(data: mmap.mmap, at: int, end: int) -> tuple[int, int]:
    value = 0
    for shift in range(0, 70, 7):
        if at >= end:
            raise ValueError("it ends inside a number")
        byte = data[at]
        at += 1
        value |= (byte & 0x7F) << shift
        if byte < 0x80:
            return value, at
    raise ValueError("a number is too long")
