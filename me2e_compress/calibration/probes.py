"""The probes of a calibration: extremes, and histograms of magnitudes."""

import dataclasses

import numpy as np
import numpy.typing as npt
import onnx_ir as ir

from me2e_compress.calibration.statistics import BINS
from me2e_compress.runtime.probing import Reading, shared_constant


@dataclasses.dataclass(frozen=True)
class Extremes:
    """Smallest element, largest element, mean square.

    The mean square shows where few elements determine the range. It also finds every
    NaN, which onnxruntime's ReduceMin and ReduceMax overlook unless it comes first.
    A tensor without elements gives infinity, minus infinity and 0.
    """

    width: int = 3

    def read(self, where: ir.Graph, value: ir.Value, at: int) -> Reading:
        """Build three reductions of the whole tensor."""
        one = shared_constant(where, np.array([1], np.int64), "one")
        least = shared_constant(where, np.array(1, np.float32), "least")
        low, high, total = (
            ir.node(op, [value], {"keepdims": 0})
            for op in ("ReduceMin", "ReduceMax", "ReduceSumSquare")
        )
        # Divide by at least 1: a tensor may be empty.
        size = ir.node("Size", [value])
        count = _cast(size.outputs[0], ir.DataType.FLOAT)
        some = ir.node("Max", [count.outputs[0], least])
        mean = ir.node("Div", [total.outputs[0], some.outputs[0]])
        # All readings are 1-D, so that they can be joined.
        flat = [
            ir.node("Reshape", [each.outputs[0], one]) for each in (low, high, mean)
        ]
        nodes = [low, high, total, size, count, some, mean, *flat]
        return nodes, [each.outputs[0] for each in flat]


@dataclasses.dataclass(frozen=True, eq=False)
class Counts:
    """A histogram of magnitudes.

    Attributes:
        exponents: int64 [tensors]: the bins of a tensor divide [0, 2^exponent).
        width: the number of bins.
    """

    exponents: npt.NDArray[np.int64]
    width: int = BINS

    def read(self, where: ir.Graph, value: ir.Value, at: int) -> Reading:
        """Compute bin numbers, and count them as a text's words are counted.

        TfidfVectorizer is the one standard operator that counts integers: exact,
        available from opset 9 on, without a second array as large as the tensor.
        Scaling by a power of two is exact: every element lies in its own bin.
        """
        bins_per_unit = np.ldexp(np.float32(BINS), -self.exponents[at])
        factor = shared_constant(
            where, np.asarray(bins_per_unit, np.float32), f"factor_{at}"
        )
        last = shared_constant(where, np.array(BINS - 1, np.float32), "last_bin")
        row = shared_constant(where, np.array([-1], np.int64), "row")
        # Number the bins; the last one takes what lies beyond.
        magnitude = ir.node("Abs", [value])
        scaled = ir.node("Mul", [magnitude.outputs[0], factor])
        capped = ir.node("Min", [scaled.outputs[0], last])
        number = _cast(capped.outputs[0], ir.DataType.INT32)
        words = ir.node("Reshape", [number.outputs[0], row])
        bins = list(range(BINS))
        # Count n-grams of length 1: the bin numbers.
        count = ir.node(
            "TfIdfVectorizer",
            [words.outputs[0]],
            {
                "mode": "TF", "min_gram_length": 1, "max_gram_length": 1,
                "max_skip_count": 0, "ngram_counts": [0], "ngram_indexes": bins,
                "pool_int64s": bins,
            },
        )  # fmt: skip
        nodes = [magnitude, scaled, capped, number, words, count]
        return nodes, [count.outputs[0]]


def _cast(value: ir.Value, to: ir.DataType) -> ir.Node:
    return ir.node("Cast", [value], {"to": to.value})
