"""A convolution whose answer a logarithm or a quotient reads stays float."""

import pytest

from me2e_compress.targets.onnxruntime.region import objection
from tests.support.nets import parsed

GRAPH = """g (float[1,2,4,4] x) => (float[1,2,4,4] y)
<float[2,2,1,1] w = {1,2,3,4}, float two = {2}> {
    ["conv"] c = Conv <kernel_shape = [1,1]> (x, w) %s
}"""


@pytest.mark.parametrize(
    ("readers", "named"),
    [
        ('["log"] y = Log(c)', "log (Log)"),
        ('["half"] y = Reciprocal(c)', "half (Reciprocal)"),
        ('["power"] y = Pow(c, two)', "power (Pow)"),
        ('["square"] y = Mul(c, c)', "square (Mul)"),
        ('["quotient"] y = Div(x, c)', "quotient (Div)"),
        ('r = Relu(c) ["log"] y = Log(r)', "log (Log)"),
        ("y = Div(c, x)", None),
        ("y = Mul(c, x)", None),
        ("r = Exp(c) y = Log(r)", None),
    ],
)
def test_what_magnifies_the_rounding_is_named(readers: str, named: str | None) -> None:
    said = objection(parsed(GRAPH % readers).graph[0])
    sentence = f"it writes uint8, whose rounding {named} magnifies"
    assert said == (named and sentence)
