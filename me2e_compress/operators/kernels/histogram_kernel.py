"""The kernel that counts magnitudes in bins, one pass over the elements."""

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from numba import types

from me2e_compress.operators.kernels.abi import ADDRESS, EACH
from me2e_compress.operators.kernels.intrinsics import (
    Word,
    address_of,
    compiled,
    create_output,
    error_status,
    floats,
    ints,
    read_input,
    stack,
    words,
)
from me2e_compress.operators.kernels.kernel import BINS, LEAST_EXPONENT

LANES = 4
"""Histograms side by side: equal elements in a row do not wait for each other."""
BIAS, MANTISSA, MAGNITUDE = 127, 23, 0x7FFFFFFF
"""Of a float32: bias of its exponent, bits of its mantissa, all bits but the sign."""
FIELD_OF_BINS = BIAS + BINS.bit_length() - 1
"""The exponent field of ``float32(BINS)``."""

_inputs = stack(types.int64, 3 * EACH)
_counts = stack(types.int32, LANES * BINS)
_slot = stack(types.int64, 1)
_bits = stack(types.int32, 1)


@compiled
def _bins_per_unit(low: int, high: int) -> Any:
    """Return BINS / 2^e of the extremes at two addresses, by the bits of float32."""
    reach = max(ints(low)[0] & MAGNITUDE, ints(high)[0] & MAGNITUDE)
    # 1.m times 2^(field - BIAS) lies below 2^(field - BIAS + 1)
    exponent = max((reach >> MANTISSA) - BIAS + 1, LEAST_EXPONENT)
    bits = _bits()
    bits[0] = (FIELD_OF_BINS - exponent) << MANTISSA
    return floats(address_of(bits))[0]


def _compute(state: int, context: int) -> Word:
    t, x, slot = words(state), _inputs(), _slot()
    for i in range(3):
        rank = read_input(t, context, i, address_of(x) + 8 * EACH * i)
        if rank != (1 if i == 0 else 0):
            return error_status(t, 0)
    # Count; NaN and infinity lie in no bin
    factor = _bins_per_unit(x[EACH + ADDRESS], x[2 * EACH + ADDRESS])
    values, counts, limit = floats(x[ADDRESS]), _counts(), np.float32(BINS)
    for i in range(LANES * BINS):
        counts[i] = 0
    for i in range(x[0]):
        scaled = abs(values[i]) * factor
        if scaled < limit:
            counts[(i % LANES) * BINS + int(scaled)] += 1
    # Add the histograms up
    slot[0] = BINS
    status = create_output(t, context, slot, 1, address_of(slot))
    if status != 0:
        return status
    out = floats(slot[0])
    for i in range(BINS):
        total = 0
        for lane in range(LANES):
            total += counts[lane * BINS + i]
        out[i] = np.float32(total)
    return 0


def _block(user: int, index: int) -> Word:
    """Nothing is left to other threads."""
    return 0


def functions(op_type: str) -> Mapping[str, Callable[[int, int], Word]]:
    """Return the functions to compile for an operator of :mod:`kernel`."""
    return {"compute": _compute, "block": _block}
