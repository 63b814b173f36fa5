"""A transformer of a few layers, as plain exporters write it."""

import numpy as np
import onnx_ir as ir

from tests.passes.small import read

TOKENS, WIDTH, HEADS = 64, 64, 2

_HEAD = """<ir_version: 9, opset_import: ["" : 17]>
m (float[1,{t},{c}] x) => (float[1,{t},{c}] y)
<int64[4] heads = {{1, {t}, {h}, {d}}}, int64[3] whole = {{1, {t}, {c}}},
 float factor = {{{f}}}> {{
"""
_LAYER = """
    ["/encoder/{i}/norm1"] n{i} = LayerNormalization<axis=-1>(x{i}, g{i}, b{i})
    ["/encoder/{i}/q"] q0{i} = MatMul(n{i}, wq{i})
    ["/encoder/{i}/k"] k0{i} = MatMul(n{i}, wk{i})
    ["/encoder/{i}/v"] v0{i} = MatMul(n{i}, wv{i})
    ["/encoder/{i}/q1"] q1{i} = Reshape(q0{i}, heads)
    ["/encoder/{i}/k1"] k1{i} = Reshape(k0{i}, heads)
    ["/encoder/{i}/v1"] v1{i} = Reshape(v0{i}, heads)
    ["/encoder/{i}/q2"] q2{i} = Transpose<perm=[0,2,1,3]>(q1{i})
    ["/encoder/{i}/k2"] k2{i} = Transpose<perm=[0,2,3,1]>(k1{i})
    ["/encoder/{i}/v2"] v2{i} = Transpose<perm=[0,2,1,3]>(v1{i})
    ["/encoder/{i}/qk"] s0{i} = MatMul(q2{i}, k2{i})
    ["/encoder/{i}/scale"] s1{i} = Mul(s0{i}, factor)
    ["/encoder/{i}/softmax"] s2{i} = Softmax<axis=-1>(s1{i})
    ["/encoder/{i}/av"] m0{i} = MatMul(s2{i}, v2{i})
    ["/encoder/{i}/back"] m1{i} = Transpose<perm=[0,2,1,3]>(m0{i})
    ["/encoder/{i}/rows"] m2{i} = Reshape(m1{i}, whole)
    ["/encoder/{i}/o"] o{i} = MatMul(m2{i}, wo{i})
    ["/encoder/{i}/add1"] r{i} = Add(x{i}, o{i})
    ["/encoder/{i}/up"] u0{i} = MatMul(r{i}, wu{i})
    ["/encoder/{i}/bias"] u1{i} = Add(u0{i}, bu{i})
    ["/encoder/{i}/relu"] u2{i} = Relu(u1{i})
    ["/encoder/{i}/down"] d{i} = MatMul(u2{i}, wd{i})
    ["/encoder/{i}/add2"] x{j} = Add(r{i}, d{i})
"""


def transformer(layers: int = 2, seed: int = 0) -> ir.Model:
    """Layer norms, attention of 64 tokens in two heads, ReLU layers; random weights."""
    draws, c = np.random.default_rng(seed), WIDTH
    shapes: dict[str, tuple[int, ...]]
    shapes = {name: (c, c) for name in ("wq", "wk", "wv", "wo")}
    shapes |= {"wu": (c, 4 * c), "wd": (4 * c, c), "g": (c,), "b": (c,), "bu": (4 * c,)}
    weights = {
        f"{name}{i}": draws.normal(name == "g", shape[0] ** -0.5, shape).astype("f")
        for i in range(layers)
        for name, shape in shapes.items()
    }
    head = _HEAD.format(t=TOKENS, c=c, h=HEADS, d=c // HEADS, f=(c // HEADS) ** -0.5)
    body = "".join(_LAYER.format(i=i, j=i + 1) for i in range(layers))
    tail = f'    ["/head/Identity"] y = Identity(x{layers})\n}}'
    return read((head + body).replace("x0", "x") + tail, **weights)
