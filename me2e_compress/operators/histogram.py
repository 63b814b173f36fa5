"""A histogram of magnitudes, for calibration."""

import dataclasses
from typing import ClassVar

import numpy as np
import onnx_ir as ir

from me2e_compress.graph.shapes import Dims
from me2e_compress.operators.base import Operator
from me2e_compress.operators.call import Attributes, FusedCall
from me2e_compress.operators.dialect import (
    OWN_DOMAIN,
    Arrays,
    Dialect,
    NdArray,
    Operand,
    Shapes,
    Values,
    present,
)
from me2e_compress.operators.kernels.kernel import BINS, DOMAIN, LEAST_EXPONENT


@dataclasses.dataclass(frozen=True)
class Histogram(Operator):
    """How many magnitudes lie in each of 2,048 equal bins of [0, 2^e).

    2^e is the least power of two that exceeds all magnitudes, and e at least -100.

    Own form ``me2e::Histogram``: X [N] float32, its least and its largest element, each
    []. Output [2048] float32.
    """

    name = "histogram"
    own = Dialect(
        "me2e", "Histogram", OWN_DOMAIN,
        (Operand("X", "N"), Operand("low", ""), Operand("high", "")), "me2e",
    )  # fmt: skip
    dialects = ()
    opset: ClassVar[int] = 9

    def output_shape(self, shapes: Shapes, attributes: Attributes) -> Dims | None:
        """Return [2048]."""
        return (BINS,)

    def body(self, call: FusedCall, inputs: Values, attributes: Attributes) -> ir.Value:
        """Compute bin numbers, and count them as TF-IDF counts the words of a text.

        TfidfVectorizer is the one standard operator that counts integers: exact up to
        2^24, without a second array as large as the tensor. Scaling by a power of two
        is exact: every element lies in its own bin.
        """
        if call.compiled:
            return call.add(self.own.op_type, inputs, domain=DOMAIN)
        value, low, high = present(inputs)

        def number(constant: float) -> ir.Value:
            return call.constant(np.array(constant, np.float32))

        # The reach, times 2^-24 so that what follows cannot overflow
        reach = [high, call.add("Neg", [low]), number(2.0 ** (LEAST_EXPONENT - 1))]
        small = call.add("Mul", [call.add("Max", reach), number(2.0**-24)])
        # Round it to one bit (Veltkamp's splitting), then up to the next power of two
        split = call.add("Mul", [small, number(2.0**23 + 1)])
        power = call.add("Sub", [split, call.add("Sub", [split, small])])
        exceeds = call.add("Greater", [power, small])
        twice = call.add("Add", [power, power])
        above = call.add("Where", [exceeds, power, twice])
        # Number the bins
        bins_per_unit = call.add("Div", [number(BINS * 2.0**-24), above])
        scaled = call.add("Mul", [call.add("Abs", [value]), bins_per_unit])
        # Count n-grams of length 1: the bin numbers
        bins = list(range(BINS))
        return call.add(
            "TfIdfVectorizer",
            [call.cast(scaled, ir.DataType.INT32)],
            {
                "mode": "TF", "min_gram_length": 1, "max_gram_length": 1,
                "max_skip_count": 0, "ngram_counts": [0], "ngram_indexes": bins,
                "pool_int64s": bins,
            },
        )  # fmt: skip

    def reference(self, inputs: Arrays, attributes: Attributes) -> NdArray:
        """Compute it in numpy, [2048] float64."""
        magnitudes = np.abs(np.asarray(inputs[0], np.float64))
        exponent = max(np.frexp(magnitudes.max(initial=0))[1], LEAST_EXPONENT)
        counts, _ = np.histogram(magnitudes, BINS, (0, 2.0**exponent))
        return counts.astype(np.float64)
