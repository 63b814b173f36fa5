"""Graphs that are broken, each in one way: by name, or drawn by a seed."""

import random
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import onnx
import onnx.parser
from google.protobuf.message import Message
from onnx import TensorProto, helper, numpy_helper

from tests.fuzz.texts import HUGE, MARKUP

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


Fault = Callable[[onnx.ModelProto], object]


def _order(*order: int) -> Fault:
    def fault(m: onnx.ModelProto) -> None:
        nodes = onnx.GraphProto(node=m.graph.node).node
        for at, source in enumerate(order):
            m.graph.node[at].CopyFrom(nodes[source])

    return fault


def _each_node(change: Callable[[onnx.NodeProto], object]) -> Fault:
    def fault(m: onnx.ModelProto) -> None:
        for node in m.graph.node:
            change(node)

    return fault


def _rename(old: str, new: str) -> Fault:
    """Write another name wherever a value, node or initializer has this one."""

    def fault(m: onnx.ModelProto) -> None:
        for node in m.graph.node:
            node.name = new if node.name == old else node.name
            for names in (node.input, node.output):
                for at, name in enumerate(names):
                    names[at] = new if name == old else name
        named: list[Any] = [*m.graph.input, *m.graph.output, *m.graph.initializer]
        for each in named:
            each.name = new if each.name == old else each.name

    return fault


def _nested(m: onnx.ModelProto, depth: int = 30) -> None:
    body = m.graph
    for _ in range(depth):
        node = body.node.add(op_type="If", input=["image"], output=["deep"])
        attribute = node.attribute.add(name="then_branch", type=5)
        attribute.g.output.add(name="o")
        body = attribute.g


def _external(key: str, value: str) -> Fault:
    def fault(m: onnx.ModelProto) -> None:
        tensor = m.graph.initializer[0]
        tensor.ClearField("raw_data")
        tensor.data_location = TensorProto.EXTERNAL
        given = {"location": "w.bin", "offset": "0", "length": "432", key: value}
        for name, text in given.items():
            tensor.external_data.add(key=name, value=text)

    return fault


def _sparse(m: onnx.ModelProto) -> None:
    values = helper.make_tensor("s", 1, [2], [1.0, 2.0])
    indices = helper.make_tensor("si", 7, [2], [0, 3])
    m.graph.sparse_initializer.append(
        helper.make_sparse_tensor(values, indices, [4, 4])
    )
    m.graph.node[7].input[1] = "s"


def _recursive(m: onnx.ModelProto) -> None:
    m.functions[0].opset_import.append(helper.make_opsetid("own", 1))
    call = helper.make_node("twice", ["x"], ["z"], domain="own")
    m.functions[0].node[0].CopyFrom(call)


def _mutual(m: onnx.ModelProto) -> None:
    _recursive(m)
    m.functions[0].node[0].op_type = "thrice"
    m.functions.add().CopyFrom(m.functions[0])
    m.functions[1].name = "thrice"
    m.functions[1].node[0].op_type = "twice"


def _set(name: str, /, **values: object) -> Fault:
    """Write fields of the first initializer, input or node that has this name."""

    def fault(m: onnx.ModelProto) -> None:
        g = m.graph
        named: list[Any] = [*g.initializer, *g.node, *g.input]
        found = next(each for each in named if each.name == name)
        for field, value in values.items():
            if isinstance(value, list):
                del getattr(found, field)[:]
                getattr(found, field).extend(value)
            else:
                setattr(found, field, value)

    return fault


def _type(name: str, change: Callable[[onnx.TypeProto], object]) -> Fault:
    def fault(m: onnx.ModelProto) -> None:
        ports = (*m.graph.input, *m.graph.output)
        change(next(port for port in ports if port.name == name).type)

    return fault


def _dim(field: str, value: object) -> Fault:
    return _type("image", lambda t: setattr(t.tensor_type.shape.dim[0], field, value))


def _tokens(*shape: int) -> Fault:
    tensor = numpy_helper.from_array(np.array(shape), "tokens")
    return lambda m: m.graph.initializer[0].CopyFrom(tensor)


def _first(field: str, value: object) -> Fault:
    return lambda m: setattr(m.graph.node[0].attribute[0], field, value)


def _attribute(node: str, **values: Any) -> Fault:
    def fault(m: onnx.ModelProto) -> None:
        found = next(each for each in m.graph.node if each.name == node)
        del found.attribute[:]
        for name, value in values.items():
            found.attribute.append(helper.make_attribute(name, value))

    return fault


def _meta(key: str, value: str) -> Fault:
    return lambda m: m.metadata_props.add(key=key, value=value)


def _stamp(key: str, value: str) -> Fault:
    return _each_node(lambda n: n.metadata_props.add(key=key, value=value))


FAULTS: dict[str, Fault] = {
    "cycle": lambda m: m.graph.node[1].input.__setitem__(0, "q"),
    "unsorted": _order(6, 1, 2, 3, 4, 5, 0),
    "reversed": _order(*reversed(range(10))),
    "output-twice": lambda m: m.graph.node[2].output.__setitem__(0, "a"),
    "names-twice": _each_node(lambda n: setattr(n, "name", "same")),
    "initializer-twice": lambda m: m.graph.initializer.append(m.graph.initializer[0]),
    "input-twice": lambda m: m.graph.input.append(m.graph.input[0]),
    "graph-output-twice": lambda m: m.graph.output.append(m.graph.output[0]),
    "input-and-initializer": lambda m: m.graph.input.add(name="w"),
    "input-is-output": lambda m: m.graph.output.add(name="image"),
    "input-is-made": lambda m: m.graph.node[1].output.__setitem__(0, "image"),
    "no-node-names": _each_node(lambda n: setattr(n, "name", "")),
    "no-output-name": lambda m: m.graph.node[1].output.__setitem__(0, ""),
    "no-input-name": lambda m: setattr(m.graph.input[0], "name", ""),
    "no-graph-output-name": lambda m: setattr(m.graph.output[0], "name", ""),
    "no-initializer-name": _set("w", name=""),
    "no-graph-name": lambda m: setattr(m.graph, "name", ""),
    "no-op-type": lambda m: setattr(m.graph.node[1], "op_type", ""),
    "no-outputs-of-a-node": lambda m: m.graph.node[1].ClearField("output"),
    "no-inputs-of-a-node": _each_node(lambda n: n.ClearField("input")),
    "input-left-out": _each_node(lambda n: n.input.__setitem__(0, "")),
    "too-many-inputs": _each_node(lambda n: n.input.extend(["w"] * 9)),
    "no-nodes": lambda m: m.graph.ClearField("node"),
    "no-inputs": lambda m: m.graph.ClearField("input"),
    "no-graph-outputs": lambda m: m.graph.ClearField("output"),
    "no-graph": lambda m: m.ClearField("graph"),
    "no-functions": lambda m: m.ClearField("functions"),
    "unknown-output": lambda m: m.graph.output.add(name="nowhere"),
    "unknown-input": lambda m: m.graph.node[1].input.__setitem__(0, "nowhere"),
    "sparse": _sparse,
    "function-recursive": _recursive,
    "functions-in-a-circle": _mutual,
    "function-twice": lambda m: m.functions.append(m.functions[0]),
    "function-of-standard-name": lambda m: setattr(m.functions[0], "domain", ""),
    "function-without-opset": lambda m: m.functions[0].ClearField("opset_import"),
    "function-without-outputs": lambda m: m.functions[0].ClearField("output"),
    "nested-30": _nested,
    "nested-90": lambda m: _nested(m, 90),
    "opset-0": lambda m: setattr(m.opset_import[0], "version", 0),
    "opset-negative": lambda m: setattr(m.opset_import[0], "version", -5),
    "opset-huge": lambda m: setattr(m.opset_import[0], "version", 2**62),
    "opset-twice": lambda m: m.opset_import.append(helper.make_opsetid("", 9)),
    "ir-0": lambda m: setattr(m, "ir_version", 0),
    "ir-99": lambda m: setattr(m, "ir_version", 99),
    "dims-negative": _set("w", dims=[-4, 3, 3, 3]),
    "dims-huge": _set("w", dims=[2**40, 2**40]),
    "dims-wrong": _set("w", dims=[4, 4]),
    "raw-short": _set("w", raw_data=b"\0\0\0"),
    "two-kinds-of-data": _set("w", float_data=[1.0]),
    "type-undefined": _set("w", data_type=0),
    "type-99": _set("w", data_type=99),
    "type-string": _set("w", data_type=8),
    "type-int4": _set("w", data_type=22),
    "nan-weights": _set("b", raw_data=b"\xff" * 16),
    "external-absolute": _external("location", "/etc/hostname"),
    "external-above": _external("location", "../../../../etc/hostname"),
    "external-missing": _external("location", "none.bin"),
    "external-folder": _external("location", "."),
    "external-zero-byte": _external("location", "a\0b"),
    "external-offset-word": _external("offset", "zero"),
    "external-offset-huge": _external("offset", HUGE),
    "external-offset-negative": _external("offset", "-8"),
    "external-length-negative": _external("length", "-432"),
    "input-untyped": lambda m: m.graph.input[0].ClearField("type"),
    "input-type-99": _type("image", lambda t: setattr(t.tensor_type, "elem_type", 99)),
    "input-string": _type("image", lambda t: setattr(t.tensor_type, "elem_type", 8)),
    "input-double": _type("image", lambda t: setattr(t.tensor_type, "elem_type", 11)),
    "input-shapeless": _type("image", lambda t: t.tensor_type.ClearField("shape")),
    "input-sequence": _type("image", lambda t: t.sequence_type.elem_type.SetInParent()),
    "input-optional": _type("image", lambda t: t.optional_type.elem_type.SetInParent()),
    "input-map": _type("image", lambda t: setattr(t.map_type, "key_type", 7)),
    "output-untyped": lambda m: m.graph.output[0].ClearField("type"),
    "output-shapeless": _type("y", lambda t: t.tensor_type.ClearField("shape")),
    "output-other-shape": _type(
        "y", lambda t: setattr(t.tensor_type.shape.dim[1], "dim_value", 77)
    ),
    "dim-negative": _dim("dim_value", -3),
    "dim-huge": _dim("dim_value", 2**62),
    "dim-zero": _dim("dim_value", 0),
    "dim-markup": _dim("dim_param", MARKUP),
    "dim-open": _dim("dim_param", "batch"),
    "perm-wrong": _attribute("/head/Transpose", perm=[0, 7, -9]),
    "perm-short": _attribute("/head/Transpose", perm=[0]),
    "perm-word": _attribute("/head/Transpose", perm="word"),
    "axis-huge": _attribute("/head/Softmax", axis=2**62),
    "axis-float": _attribute("/head/Softmax", axis=1.5),
    "kernel-zero": _attribute("/backbone/Conv", kernel_shape=[0, 0]),
    "kernel-huge": _attribute("/backbone/Conv", kernel_shape=[2**40, 2**40]),
    "pads-negative": _attribute("/backbone/Conv", pads=[-9, -9, -9, -9]),
    "strides-zero": _attribute("/backbone/Conv", strides=[0, 0]),
    "group-zero": _attribute("/backbone/Conv", group=0),
    "group-negative": _attribute("/backbone/Conv", group=-2),
    "auto-pad-unknown": _attribute("/backbone/Conv", auto_pad="SOMETIMES"),
    "attribute-twice": lambda m: m.graph.node[0].attribute.append(
        m.graph.node[0].attribute[0]
    ),
    "attribute-untyped": _first("type", 0),
    "attribute-of-type-99": _first("type", 9),
    "attribute-nameless": _first("name", ""),
    "attribute-refers": _first("ref_attr_name", "outer"),
    "reshape-impossible": _tokens(7, -1, -1),
    "reshape-huge": _tokens(2**40, 2**40, 1),
    "domain-unknown": _each_node(lambda n: setattr(n, "domain", "nobody.knows")),
    "domain-markup": _each_node(lambda n: setattr(n, "domain", MARKUP)),
    "op-markup": lambda m: setattr(m.graph.node[1], "op_type", MARKUP),
    "node-markup": _each_node(lambda n: setattr(n, "name", n.name + MARKUP)),
    "input-markup": _rename("image", MARKUP),
    "weight-markup": _rename("w", MARKUP),
    "output-markup": _rename("y", MARKUP),
    "output-path": _rename("y", "../../etc/passwd"),
    "output-long": _rename("y", "y" * 70000),
    "recurrent-deep": _meta("me2e.recurrent", "[" * 100_000),
    "recurrent-list": _meta("me2e.recurrent", "[1]"),
    "recurrent-number": _meta("me2e.recurrent", HUGE),
    "recurrent-unknown": _meta("me2e.recurrent", '{"memory": "nowhere"}'),
    "recurrent-shape": _meta("me2e.recurrent", '{"memory": "y"}'),
    "plan-deep": _meta("me2e.plan", '{"a":' * 100_000),
    "plan-number": _meta("me2e.plan", f'{{"output": {HUGE}}}'),
    "plan-mode": _meta("me2e.plan", '{"output": "y", "default_mode": -1}'),
    "quant-plan-deep": _meta("me2e.quant_plan", "[" * 100_000),
    "quant-plan-empty": _meta("me2e.quant_plan", "{}"),
    "quant-plan-torn": _meta("me2e.quant_plan", "eJyr"),
    "origins-deep": _meta("me2e.origins", "[" * 100_000),
    "origins-torn": _meta("me2e.origins", "eJyr"),
    "stamp-module": _stamp("me2e.module", MARKUP),
    "stamp-origin": _stamp("me2e.origin", "[" * 5000),
    "stamp-empty": _stamp("me2e.module", ""),
    "value-info-lies": lambda m: m.graph.value_info.append(
        helper.make_tensor_value_info("r", 6, [9, 9])
    ),
    "training": lambda m: m.training_info.add().algorithm.node.add(op_type="Relu"),
}


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
