"""Graphs that are broken, each in one way: by name, or drawn by a seed."""

import random
from collections.abc import Iterator
from typing import Any

import numpy as np
import onnx
import onnx.parser
from google.protobuf.message import Message
from onnx import numpy_helper

from tests.fuzz.faults import FAULTS
from tests.fuzz.texts import MARKUP

SEED_TEXT = """
<ir_version: 9, opset_import: ["" : 17, "own" : 1]>
net (float[1,3,4,4] image, float[1,4,16] memory)
    => (float[1,4,4] y, float[1,4,16] memory_out)
<int64[3] tokens = {1, 4, 16}, float half = {0.5}> {
    ["/backbone/Conv"] a = Conv<kernel_shape=[3,3], pads=[1,1,1,1]>(image, w, b)
    ["/backbone/Relu"] r = Relu(a)
    ["/backbone/Reshape"] flat = Reshape(r, tokens)
    ["/head/Add"] seen = Add(flat, memory)
    ["/head/Transpose"] q = Transpose<perm=[0,2,1]>(seen)
    ["/head/QK"] scores = MatMul(seen, q)
    ["/head/Softmax"] p = Softmax<axis=-1>(scores)
    ["/head/Linear"] l1 = MatMul(p, l)
    ["/head/Twice"] y = own.twice(l1)
    ["/head/Mul"] memory_out = Mul(seen, half)
}
<domain: "own", opset_import: ["" : 17]>
twice (x) => (z) { z = Add(x, x) }
"""

BRANCH_TEXT = """
<ir_version: 9, opset_import: ["" : 17]>
branch (float[2] x, bool c) => (float[2] y) {
    ["/a/If"] t = If (c) <
        then_branch = yes () => (float[2] u) { u = Relu(x) },
        else_branch = no () => (float[2] v) { v = Neg(x) }
    >
    ["/b/Add"] y = Add(t, x)
}
"""


def seed_graph() -> onnx.ModelProto:
    """A convolution, an attention, a recurrent memory and a local function."""
    model = onnx.parser.parse_model(SEED_TEXT)
    draws = np.random.default_rng(0)
    for name, shape in (("w", (4, 3, 3, 3)), ("b", (4,)), ("l", (4, 4))):
        array = draws.standard_normal(shape).astype(np.float32)
        model.graph.initializer.append(numpy_helper.from_array(array, name))
    return model


def branch_graph() -> onnx.ModelProto:
    """An If whose branches read a value of the graph around them."""
    return onnx.parser.parse_model(BRANCH_TEXT)


def broken_graphs() -> Iterator[tuple[str, bytes]]:
    """Yield the graphs that have a fault by name, as files."""
    for name, fault in FAULTS.items():
        model = seed_graph()
        fault(model)
        yield name, model.SerializeToString()


def broken_files() -> Iterator[tuple[str, bytes]]:
    """Yield files that hold no whole graph."""
    whole = seed_graph().SerializeToString()
    yield from {
        "empty": b"",
        "text": b"this is no graph\n",
        "zeros": bytes(4096),
        "json": b'{"ir_version": 9}',
        "half": whole[: len(whole) // 2],
        "one-byte-less": whole[:-1],
        "twice": whole + whole,
        "deep-message": _deep(4000),
        "deep-message-99": _deep(45),
        "wrong-utf-8": whole.replace(b"/head/Add", b"/head/\xff\xfe\xfd"),
        "length-lies": b"\x3a\xff\xff\xff\xff\x7f",
    }.items()


def _deep(levels: int) -> bytes:
    """A graph in a node of a graph in a node ... as bytes: graph.node.attribute.g."""
    inner = b""
    for _ in range(levels):
        for field in (6, 5, 1):
            inner = bytes([field << 3 | 2]) + _varint(len(inner)) + inner
    return b"\x08\x09" + bytes([7 << 3 | 2]) + _varint(len(inner)) + inner


def _varint(value: int) -> bytes:
    out = bytearray()
    while value >= 128:
        out.append(value % 128 + 128)
        value //= 128
    return bytes([*out, value])


def drawn_graph(seed: int) -> tuple[str, bytes]:
    """Draw one to three changes anywhere in a graph, or flip bytes of its file."""
    draw = random.Random(seed)
    model = draw.choice((seed_graph, seed_graph, branch_graph))()
    if draw.random() < 0.15:
        content = bytearray(model.SerializeToString())
        for _ in range(draw.randint(1, 4)):
            content[draw.randrange(len(content))] = draw.randrange(256)
        return f"bytes-{seed}", bytes(content)
    done = [_change(model, draw) for _ in range(draw.randint(1, 3))]
    return f"drawn-{seed}-{'-'.join(done)}", model.SerializeToString()


def _messages(message: Message) -> Iterator[Message]:
    yield message
    for field, value in message.ListFields():
        if field.type == field.TYPE_MESSAGE:
            many = value if field.is_repeated else [value]
            for each in many:
                yield from _messages(each)


def _change(model: onnx.ModelProto, draw: random.Random) -> str:
    """Change, clear, repeat or drop one field of one message."""
    message = draw.choice(list(_messages(model)))
    fields: list[Any] = list(message.DESCRIPTOR.fields)
    there: list[Any] = [field for field, _ in message.ListFields()]
    field: Any = draw.choice(there if there and draw.random() < 0.8 else fields)
    if draw.random() < 0.2:
        message.ClearField(field.name)
    elif field.is_repeated:
        _change_list(getattr(message, field.name), field, draw)
    elif field.type == field.TYPE_MESSAGE:
        getattr(message, field.name).SetInParent()
    else:
        setattr(message, field.name, _value(field, draw))
    return f"{message.DESCRIPTOR.name}.{field.name}"


def _change_list(values: Any, field: Any, draw: random.Random) -> None:
    kind = draw.randrange(3)
    if field.type == field.TYPE_MESSAGE:
        if values and kind == 0:
            values.append(draw.choice(list(values)))
        elif values and kind == 1:
            del values[draw.randrange(len(values))]
        else:
            values.add()
    elif values and kind == 0:
        del values[draw.randrange(len(values))]
    elif values and kind == 1:
        values[draw.randrange(len(values))] = _value(field, draw)
    else:
        values.append(_value(field, draw))


NAMES = ("image", "w", "b", "a", "r", "flat", "seen", "q", "y", "", "x", "t", "u", "z")


def _value(field: Any, draw: random.Random) -> object:
    if field.enum_type is not None:
        return draw.choice([each.number for each in field.enum_type.values])
    if field.cpp_type in (field.CPPTYPE_FLOAT, field.CPPTYPE_DOUBLE):
        return draw.choice((0.0, -1.0, float("nan"), float("inf"), 1e38))
    if field.cpp_type == field.CPPTYPE_STRING:
        word = draw.choice((*NAMES, MARKUP, "Relu", "If", "Loop", "own", "twice"))
        return word.encode() if field.type == field.TYPE_BYTES else word
    small = (0, 1, -1, 2, 3, 7, 8, 9, 11, 15, 99, 2**31 - 1, -(2**31))
    if field.cpp_type == field.CPPTYPE_INT32:
        return draw.choice(small)
    if field.cpp_type in (field.CPPTYPE_UINT32, field.CPPTYPE_UINT64):
        return draw.choice((0, 1, 2, 99))
    return draw.choice((*small, 2**40, 2**63 - 1, -(2**63)))
