"""What share of this core's int8 peak onnxruntime's kernels reach, by shape.

    python -m benchmarks.measure.int8_shapes [--rounds 15]

Each layer alone, uint8 by int8 with one scale a channel, on one thread, the least CPU
time of rounds that alternate. First the products of VAD-tiny in every form that
onnxruntime has a kernel for, then the convolutions of its ResNet-50, at six cameras of
384 x 640, and other forms of those that lie below: more channels, blocks of pixels,
half of the pixels where every second one is read. The peak is the best rate of all.
Convolutions have the channels last, as onnxruntime's sessions compute them.
"""

import argparse
import dataclasses
import functools
import math
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt
import onnx
import onnxruntime as ort

from benchmarks.tools.processes import in_turn
from me2e_compress.runtime.profile import processor

FORMS = {
    "QGemm, float32": ("com.microsoft.QGemm(x, xs, z, w, ws, wz, b)", "float"),
    "QGemm, uint8": ("com.microsoft.QGemm(x, xs, z, w, ws, wz, b, xs, z)", "uint8"),
    "MatMulIntegerToFloat": (
        "com.microsoft.MatMulIntegerToFloat(x, w, xs, ws, z, wz, bias)",
        "float",
    ),
    "MatMulInteger": ("MatMulInteger(x, w, z)", "int32"),
    "QLinearMatMul": ("QLinearMatMul(x, xs, z, w, ws, wz, xs, z)", "uint8"),
}
"""Kernels of products, and what they give."""

PRODUCTS = ((20_000, 256, 256), (10_000, 256, 512), (10_000, 512, 256), (300, 256, 256))
"""Rows, K, N: values of two frames, a feed-forward network's two products, objects."""


@dataclasses.dataclass(frozen=True)
class Convolution:
    """One convolution with padding that keeps its size, before the stride."""

    name: str
    images: int
    height: int
    width: int
    channels: int
    outputs: int
    kernel: int = 1
    stride: int = 1

    @property
    def pixels(self) -> tuple[int, int]:
        """Return height and width of the answer."""
        return self.height // self.stride, self.width // self.stride

    @property
    def macs(self) -> int:
        """Return its multiply-accumulates."""
        taps = self.channels * self.kernel**2
        return self.images * math.prod(self.pixels) * self.outputs * taps

    def text(self) -> str:
        """Write the layer alone."""
        before = self.kernel // 2
        behind = self.kernel - 1 - before
        size = f"{self.images},{self.height},{self.width},{self.channels}"
        options = (
            f"channels_last=1, kernel_shape=[{self.kernel},{self.kernel}],"
            f" strides=[{self.stride},{self.stride}],"
            f" pads=[{before},{before},{behind},{behind}]"
        )
        call = f"com.microsoft.QLinearConv<{options}>(x, xs, z, w, ws, wz, xs, z, b)"
        return _text(size, call, "uint8")


def resnet() -> Iterator[Convolution]:
    """Yield the layers of a ResNet-50 that differ in shape, and other forms of some."""
    yield Convolution("first", 6, 384, 640, 3, 64, 7, 2)
    yield Convolution("first, four channels", 6, 384, 640, 4, 64, 7, 2)
    yield Convolution("first, blocks of 2 x 2", 6, 192, 320, 12, 64, 4)
    for stage, (height, width, inner) in enumerate(
        ((96, 160, 64), (48, 80, 128), (24, 40, 256), (12, 20, 512)), 1
    ):
        at, outer = f"stage {stage}", 4 * inner
        yield Convolution(f"{at} in", 6, height, width, outer, inner)
        yield Convolution(f"{at} 3 x 3", 6, height, width, inner, inner, 3)
        yield Convolution(f"{at} out", 6, height, width, inner, outer)
        if stage > 1:
            full = 2 * height, 2 * width, outer // 2
            yield Convolution(f"{at} shortcut", 6, *full, outer, stride=2)
            half = height, width, outer // 2
            yield Convolution(f"{at} shortcut, pixels cut first", 6, *half, outer)


def _text(size: str, call: str, kind: str) -> str:
    return f"""<ir_version: 9, opset_import: ["" : 17, "com.microsoft" : 1]>
    layer (uint8[{size}] x) => ({kind}[N] y) {{ y = {call} }}"""


def session(text: str, filter_shape: Sequence[int], axis: int) -> ort.InferenceSession:
    """Open one layer with weights of its shape, its channels along an axis."""
    model = onnx.parser.parse_model(text)
    model.graph.output[0].type.tensor_type.ClearField("shape")
    random = np.random.default_rng(0)
    channels = filter_shape[axis]
    constants: dict[str, npt.NDArray[Any]] = {
        "w": random.integers(-127, 128, filter_shape).astype(np.int8),
        "ws": np.full(channels, 0.001, np.float32),
        "wz": np.zeros(channels, np.int8),
        "xs": np.array(0.03, np.float32),
        "z": np.array(128, np.uint8),
        "b": random.integers(-999, 999, channels).astype(np.int32),
        "bias": np.ones(channels, np.float32),
    }
    read = set(model.graph.node[0].input)
    for name, array in constants.items():
        if name in read:
            model.graph.initializer.append(onnx.numpy_helper.from_array(array, name))
    options = ort.SessionOptions()
    options.intra_op_num_threads = 1
    options.log_severity_level = 4
    return ort.InferenceSession(
        model.SerializeToString(), options, providers=["CPUExecutionProvider"]
    )


def product(form: str, rows: int, size: tuple[int, int]) -> ort.InferenceSession:
    """Open a product of ``rows`` by [K, N] in one of its forms."""
    call, kind = FORMS[form]
    return session(_text(f"{rows},{size[0]}", call, kind), size, 1)


def milliseconds(sessions: dict[str, ort.InferenceSession], rounds: int) -> list[float]:
    """Time layers in turn on random pixels: the least CPU time of each."""
    random = np.random.default_rng(1)

    works = {}
    for name, each in sessions.items():
        pixels = random.integers(0, 256, each.get_inputs()[0].shape, np.uint8)
        works[name] = functools.partial(each.run, None, {"x": pixels})
    return [min(taken) * 1e3 for taken in in_turn(works, rounds).values()]


def measured(rounds: int) -> list[tuple[str, float, float]]:
    """Return name, milliseconds and GMAC/s of every layer and form."""
    found = []
    for rows, depth, columns in PRODUCTS:
        name = f"[{rows}, {depth}] x [{depth}, {columns}]"
        forms = {
            f"{name}, {form}": product(form, rows, (depth, columns)) for form in FORMS
        }
        pixels = Convolution("", 1, rows, 1, depth, columns)
        forms[f"{name}, QLinearConv"] = session(
            pixels.text(), (columns, depth, 1, 1), 0
        )
        for form, taken in zip(forms, milliseconds(forms, rounds), strict=True):
            found.append((form, taken, pixels.macs / taken / 1e6))
    layers = list(resnet())
    sessions = {
        each.name: session(
            each.text(), (each.outputs, each.channels, each.kernel, each.kernel), 0
        )
        for each in layers
    }
    for each, taken in zip(layers, milliseconds(sessions, rounds), strict=True):
        found.append((each.name, taken, each.macs / taken / 1e6))
    return found


def main() -> None:
    """Measure every shape and print a table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--rounds", type=int, default=15)
    rows = measured(parser.parse_args().rounds)
    peak = max(rate for _, _, rate in rows)
    print(
        f"{processor()}, one thread, onnxruntime {ort.__version__}: {peak:.0f} GMAC/s"
    )
    print("\n| layer | ms | GMAC/s | of peak |\n|---|---:|---:|---:|")
    for name, taken, rate in rows:
        print(f"| {name} | {taken:.2f} | {rate:.0f} | {rate / peak:.0%} |")


if __name__ == "__main__":
    main()
