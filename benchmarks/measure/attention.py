"""Attention as one operator, and as the nodes that exporters write.

    python -m benchmarks.measure.attention [--tokens 300,900,2000] [--threads 2]
        [--rounds 7]

Eight heads of 32 channels, as many keys as queries, float32: ``MultiHeadAttention`` of
onnxruntime, the ONNX operator ``Attention`` of opset 23, the toolkit's compiled kernel,
and scale, transpose, product, softmax, product and transpose. In turn in one process;
least CPU seconds of all threads. Below 1, the operator is faster.
"""

import argparse
from functools import partial

import numpy as np
import onnx_ir as ir
import onnxruntime as ort

from benchmarks.tools.processes import in_turn
from me2e_compress.runtime.profile import processor
from me2e_compress.runtime.session import Session

HEADS, CHANNELS = 8, 32
ROW = HEADS * CHANNELS
HEAD = '<ir_version: 10, opset_import: ["" : 23, "com.microsoft" : 1, "me2e" : 1]>'
SPLIT = f"shape = Constant<value = int64[4] {{0, 0, {HEADS}, {CHANNELS}}}>()\n"
JOIN = f"flat = Constant<value = int64[3] {{0, 0, {ROW}}}>()\n"
NODES = (
    SPLIT
    + JOIN
    + f"""
    scale = Constant<value = float {{{CHANNELS**-0.5}}}>()
    q4 = Reshape(q, shape)
    k4 = Reshape(k, shape)
    v4 = Reshape(v, shape)
    qt = Transpose<perm = [0, 2, 1, 3]>(q4)
    kt = Transpose<perm = [0, 2, 3, 1]>(k4)
    vt = Transpose<perm = [0, 2, 1, 3]>(v4)
    small = Mul(qt, scale)
    scores = MatMul(small, kt)
    weights = Softmax<axis = -1>(scores)
    read = MatMul(weights, vt)
    rows = Transpose<perm = [0, 2, 1, 3]>(read)
    y = Reshape(rows, flat)
    """
)
FORMS = {
    "as exported": NODES,
    "MultiHeadAttention": f"y = com.microsoft.MultiHeadAttention<num_heads = {HEADS}>"
    "(q, k, v)",
    "Attention": f"y = Attention<q_num_heads = {HEADS}, kv_num_heads = {HEADS}>"
    "(q, k, v)",
    "compiled kernel": f"y = me2e.MultiHeadAttention<heads = {HEADS}>(q, k, v)",
}


def opened(form: str, tokens: int, threads: int) -> Session:
    """Open one form of attention over so many tokens."""
    shape = f"float[1,{tokens},{ROW}]"
    text = f"{HEAD} m ({shape} q, {shape} k, {shape} v) => ({shape} y) {{ {form} }}"
    return Session(ir.from_onnx_text(text), threads=threads)


def measured(tokens: int, threads: int, rounds: int) -> dict[str, float]:
    """Return least CPU seconds of every form, in turn."""
    draws = np.random.default_rng(0)
    feeds = {name: draws.normal(size=(1, tokens, ROW)) for name in "qkv"}
    fed = {name: each.astype(np.float32) for name, each in feeds.items()}
    sessions = {name: opened(each, tokens, threads) for name, each in FORMS.items()}
    works = {name: partial(each.run, fed) for name, each in sessions.items()}
    return {name: min(seconds) for name, seconds in in_turn(works, rounds).items()}


def main() -> None:
    """Measure, and print a table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--tokens", default="300,900,2000")
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--rounds", type=int, default=7)
    given = parser.parse_args()
    print(f"{processor()}, {given.threads} threads, onnxruntime {ort.__version__}\n")
    print(f"| tokens | {' | '.join(FORMS)} |\n|---|{'---:|' * len(FORMS)}")
    for tokens in map(int, given.tokens.split(",")):
        found = measured(tokens, given.threads, given.rounds)
        plain = found["as exported"]
        cells = [f"{each * 1e3:.1f} ms ({each / plain:.2f})" for each in found.values()]
        print(f"| {tokens} | {' | '.join(cells)} |", flush=True)


if __name__ == "__main__":
    main()
