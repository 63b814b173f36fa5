"""Every motif by name, and how often it is drawn."""

from collections.abc import Callable, Mapping

from tests.fuzz.exact.builder import Builder
from tests.fuzz.exact.motifs import attention as at
from tests.fuzz.exact.motifs import bodies, deformable, norms, oddities, rows, variety
from tests.fuzz.exact.motifs import convolutions as cv
from tests.fuzz.exact.motifs import linear as ln
from tests.fuzz.exact.motifs import shape_arithmetic as sh

Motif = Callable[[Builder], None]

MOTIFS: Mapping[str, tuple[Motif, float]] = {
    "one-layer": (ln.one_layer, 2),
    "layers-in-a-row": (ln.layers_in_a_row, 2),
    "on-positions": (ln.on_positions, 2),
    "on-columns": (ln.on_columns, 2),
    "same-source": (ln.same_source, 2),
    "repeated-rows": (rows.repeated_rows, 6),
    "repeated-layer": (rows.repeated_layer, 3),
    "layer-norm": (norms.layer_norm, 1.5),
    "rms-norm": (norms.rms_norm, 1),
    "gelu": (norms.gelu, 1.5),
    "swish": (norms.swish, 1),
    "hard-swish": (norms.hard_swish, 1),
    "mish": (norms.mish, 1),
    "constant-chain": (norms.constant_chain, 2),
    "powers": (norms.powers, 1),
    "conv-and-norm": (cv.conv_and_norm, 2.5),
    "shared-kernel": (cv.shared_kernel, 3),
    "shared-square": (cv.shared_square, 2.5),
    "follow-a-layer": (cv.follow_a_layer, 1.5),
    "pooled": (cv.pooled, 1),
    "network-head": (cv.network_head, 1.5),
    "alias-of-a-weight": (cv.alias_of_a_weight, 1),
    "gathered-batches": (rows.gathered_batches, 0.7),
    "attention": (at.attention, 3),
    "shared-operand": (at.shared_operand, 2),
    "computed-reshape": (sh.computed_reshape, 1.5),
    "split-heads": (sh.split_heads, 1),
    "filled": (sh.filled, 1),
    "counted": (sh.counted, 1),
    "expanded-by-shape": (sh.expanded_by_shape, 1),
    "sliced-by-shape": (sh.sliced_by_shape, 1),
    "given-back": (sh.given_back, 0.5),
    "no-ops": (oddities.no_ops, 2),
    "pairs": (oddities.pairs, 2),
    "twins": (oddities.twins, 1.5),
    "empty-inputs": (oddities.empty_inputs, 1),
    "odd-constants": (oddities.odd_constants, 1.5),
    "nothing-at-all": (oddities.nothing_at_all, 0.5),
    "indices": (oddities.indices, 0.7),
    "branches": (oddities.branches, 1),
    "grown-by-a-constant": (variety.grown_by_a_constant, 1.5),
    "odd-products": (variety.odd_products, 1.5),
    "full-bias": (variety.full_bias, 1),
    "reduced": (variety.reduced, 1),
    "cut": (variety.cut, 1),
    "cast-about": (variety.cast_about, 1),
    "defaults": (variety.defaults, 1),
    "several-axes": (variety.several_axes, 0.7),
    "chosen": (variety.chosen, 0.7),
    "if": (bodies.branch, 2.5),
    "loop": (bodies.loop, 1),
    "scan": (bodies.scan, 0.7),
    "function": (bodies.called, 1),
    "deformable": (deformable.decomposed, 3),
    "plugin": (deformable.plugin, 2),
}
"""What a graph is composed of, and how often each is drawn beside the others."""
