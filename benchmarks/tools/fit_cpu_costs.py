"""Fit the constants of :class:`CpuSeconds` to this machine.

    python -m benchmarks.tools.fit_cpu_costs

Layers of 120 sizes, and chains of them, are timed in float and in int8, in turn, on one
thread; the constants are the non-negative least squares of relative errors. Prints
them, the median error, and the layers that they miss most. About two CPU minutes.
"""

import dataclasses
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence

import numpy as np
import numpy.typing as npt
from scipy.optimize import nnls

from benchmarks.tools.layer_timing import Layer, time_both
from me2e_compress.targets.onnxruntime.costs import (
    CpuSeconds,
    costs_of,
    work_of,
)

FEATURES = ((16, 56), (32, 112), (64, 28), (64, 56), (128, 28), (256, 14), (256, 56))
"""Channels and side of square feature maps."""
ROWS = (4, 16, 64, 300, 1000, 2500, 10000)
LINES = ((16, 96), (32, 200), (8, 24))
"""Channels outside and within the blocks of a network that reads lines of text."""
PRODUCTS = ((32, 16), (64, 64), (256, 32), (256, 256), (256, 512), (512, 256))
Numbers = npt.NDArray[np.float64]


def layers() -> Iterator[Layer]:
    """Yield the layers that constants are fitted to."""
    for channels, side in FEATURES:
        read = (1, channels, side, side)
        for kernel in (1, 3):
            weight = (channels, channels, kernel, kernel)
            pads = f"pads=[{','.join([str(kernel // 2)] * 4)}]"
            for length in (1, 4):
                if channels * side * kernel < 30000:
                    yield Layer("Conv", read, weight, pads, relu=True, length=length)
        for kernel in (3, 5):
            edge = kernel // 2
            text = f"group={channels}, pads=[{edge},{edge},{edge},{edge}]"
            weight = (channels, 1, kernel, kernel)
            for length in (1, 4):
                yield Layer("Conv", read, weight, text, relu=True, length=length)
    # lines of text, and channels that are no multiple of four
    for high in (2, 12):
        for inner, outer in LINES:
            for weight in ((outer, inner, 1, 1), (inner, outer, 1, 1)):
                read = (1, weight[1], high, 96)
                yield Layer("Conv", read, weight, relu=True)
            read, text = (1, outer, high, 96), f"group={outer}, pads=[2,2,2,2]"
            yield Layer("Conv", read, (outer, 1, 5, 5), text, relu=True)
    for channels, side in ((30, 56), (63, 28), (66, 56), (130, 28)):
        for kernel in (1, 3):
            weight, edge = (channels, channels, kernel, kernel), kernel // 2
            pads = f"pads=[{edge},{edge},{edge},{edge}]"
            for length in (1, 4):
                read = (1, channels, side, side)
                yield Layer("Conv", read, weight, pads, relu=True, length=length)
    yield Layer("Conv", (1, 3, 224, 224), (64, 3, 7, 7), "strides=[2,2]", relu=True)
    yield Layer("Conv", (1, 3, 224, 224), (16, 3, 3, 3), "strides=[2,2]")
    yield Layer("Conv", (6, 3, 96, 160), (32, 3, 3, 3), "strides=[2,2]")
    yield Layer("Conv", (1, 64, 56, 56), (256, 64, 1, 1))
    yield Layer("Conv", (1, 256, 56, 56), (64, 256, 1, 1), relu=True)
    yield Layer("Conv", (1, 576, 1, 1), (144, 576, 1, 1))
    for rows in ROWS:
        for inner, columns in PRODUCTS:
            if rows * inner * columns < 2e9:
                yield Layer("MatMul", (1, rows, inner), (inner, columns))


def main() -> None:
    """Time, fit, print."""
    timed = [(layer, *time_both(layer)) for layer in layers()]
    counts = [_both_counts(layer) for layer, _, _ in timed]
    float_s = np.array([seconds for _, seconds, _ in timed])
    int8_s = np.array([seconds for _, _, seconds in timed])
    names = [each.name for each in dataclasses.fields(CpuSeconds)][1:]
    # The call of a session takes as long for both forms.
    table = [
        *([*_row(names, plain), 1.0] for plain, _ in counts),
        *([*_row(names, quantized), 1.0] for _, quantized in counts),
    ]
    times = np.concatenate([float_s, int8_s])
    weights = np.array(table) / times[:, None]
    found, _ = nnls(weights, np.ones(len(times)))
    for name, value in zip([*names, "call"], found, strict=True):
        print(f"    {name}={value * 1e9:.3g},")
    report(timed, np.array(table) @ found)


def report(timed: Sequence[tuple[Layer, float, float]], predicted: Numbers) -> None:
    """Print errors and signs."""
    count = len(timed)
    measured = np.array([each[1] for each in timed] + [each[2] for each in timed])
    errors = predicted / measured - 1
    gain = measured[:count] - measured[count:]
    expected = predicted[:count] - predicted[count:]
    right = np.sign(gain) == np.sign(expected)
    print(f"{count} layers, median error {np.median(np.abs(errors)):.1%}")
    print(f"sign of what int8 saves right for {right.mean():.1%}")
    for index in np.argsort(-np.abs(errors))[:8]:
        form = "float" if index < count else "int8"
        layer = timed[index % count][0]
        print(
            f"{errors[index]:+.0%} {form}: {layer.op} {layer.read} by {layer.weight}"
            f" x {layer.length}, {measured[index] * 1e6:.0f} µs"
        )


def _both_counts(layer: Layer) -> tuple[Counter[str], Counter[str]]:
    """Count the work of a layer in float, and in int8 with all that it quantizes."""
    model = layer.graph()
    nodes = [node for node in model.graph if node.op_type == layer.op]
    plain, quantized = Counter[str](), Counter[str]()
    for node in nodes:
        work = work_of(node)
        if work is not None:
            plain.update(work[0])
            quantized.update(work[1])
    for name in ("kernel", "quantize", "dequantize"):
        costs = costs_of(model, nodes, _unit(name))
        paid = sum(border.paid_s(frozenset(nodes)) for border in costs.borders)
        quantized[name] += round(paid * 1e9)
    return plain, quantized


def _unit(name: str) -> CpuSeconds:
    """Return a machine on which one piece of work takes 1 ns, and all others 0."""
    names = [each.name for each in dataclasses.fields(CpuSeconds)][1:]
    return CpuSeconds("unit", *(float(each == name) for each in names))


def _row(names: Sequence[str], counts: Mapping[str, int]) -> list[float]:
    return [float(counts.get(name, 0)) for name in names]


if __name__ == "__main__":
    main()
