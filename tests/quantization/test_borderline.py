"""What is close about an attention that a rule keeps, or does not keep, in float."""

import pytest

from me2e_compress.quantization.plan import make_plan
from me2e_compress.quantization.rules import RULE_SETS
from me2e_compress.quantization.scheme import QuantScheme
from tests.nets import MODULES, net

HEAD = QuantScheme.of(("head",), MODULES)


@pytest.mark.parametrize(
    ("queries", "keys", "remark"),
    [
        (512, 300, "close to the limit of 512"),
        (300, 530, "close to the limit of 512"),
        (576, 576, "close to the limit of 512"),
        (448, 448, "close to the limit of 512"),
        (901, 300, "one within the limit of 512, one beyond"),
        (512, 577, "one within the limit of 512, one beyond"),
        (513, 577, ""),
        (447, 447, ""),
        (300, 300, ""),
        (900, 900, ""),
    ],
)
def test_borderline_attention_is_reported(queries: int, keys: int, remark: str) -> None:
    text = (
        f"a (float[{queries},32] q, float[32,{keys}] k, float[{keys},32] v)"
        f" => (float[{queries},32] y)"
        " { s = MatMul(q, k) p = Softmax(s) y = MatMul(p, v) }"
    )
    plan = make_plan(net(text, {}), HEAD, RULE_SETS.parse("safe"))

    assert [remark in each.borderline for each in plan.decisions] == [
        True, not remark, True,
    ]  # fmt: skip
    assert len(plan.borderline) == (2 if remark else 0)
