"""A second run finds nothing that the first could have found."""

from me2e_compress.passes.eliminate_redundant import EliminateRedundant
from tests.passes.small import apply, ops, read


def test_what_a_copied_output_says_of_shapes_is_used_at_once() -> None:
    model = read(
        """<ir_version: 9, opset_import: ["" : 17]>
        g (float[1,8] x, int64[2] s) => (float[4,2] y, float[4,2] z)
        <int64[1] first = {0}, int64[1] last = {-1}> {
            r = Reshape(x, s)
            y = Identity(r)
            u = Unsqueeze(r, first)
            t = Transpose<perm = [1, 2, 0]>(u)
            z = Squeeze(t, last)
        }"""
    )
    apply(EliminateRedundant(), model)
    assert ops(model) == ["Reshape", "Reshape"]
