"""Plugin graphs as exporters write them: no domain, no value_info, open outputs."""

import pytest

from me2e_compress.targets import TARGETS, LintFinding
from tests.plugins import exported


def found(target: str, *, shapes: bool, domain: str = "") -> tuple[LintFinding, ...]:
    return TARGETS.parse(target).lint(exported(shapes=shapes, domain=domain))


@pytest.mark.parametrize("domain", ["", "custom_op", "trt.plugins"])
def test_tensorrt_takes_known_plugins_in_any_domain(domain: str) -> None:
    assert found("tensorrt", shapes=True, domain=domain) == ()


def test_a_plugin_that_tells_no_shape_is_a_warning_with_the_way_out() -> None:
    findings = found("tensorrt", shapes=False)
    assert {(each.severity, each.rule) for each in findings} == {
        ("warning", "plugin-shape")
    }
    assert [each.node for each in findings] == ["/rotate", "/inverse"]
    assert "value_info" in findings[0].message


def test_onnxruntime_refuses_the_plugins_and_nothing_else() -> None:
    findings = found("onnxruntime", shapes=True)
    assert [(each.rule, each.node) for each in findings] == [
        ("operator", "/rotate"),
        ("operator", "/inverse"),
    ]


def test_a_plugin_of_the_default_domain_is_held_against_its_signature() -> None:
    model = exported(shapes=True)
    del model.graph[1].attributes["interpolation"]
    (each,) = TARGETS.parse("tensorrt").lint(model)
    assert (each.rule, each.node) == ("plugin", "/rotate")


def test_an_operator_that_nobody_knows_stays_an_error() -> None:
    model = exported(shapes=True)
    model.graph[1].op_type = "Convv"
    (each,) = TARGETS.parse("tensorrt").lint(model)
    assert "ai.onnx::Convv is neither an operator nor a known plugin" in each.message
