import numpy as np
import onnx_ir as ir

from me2e_compress.graph import provenance, rewrite


def test_a_constant_takes_a_free_name(driver: ir.Model) -> None:
    taken = [str(driver.graph[0].outputs[0].name), str(driver.graph.inputs[0].name)]

    made = [
        rewrite.add_constant(driver.graph, np.zeros(2), n) for n in (*taken, "c", "c")
    ]

    assert [value.name for value in made] == [*(f"{n}_1" for n in taken), "c", "c_1"]


def test_an_heir_unites_the_origins(driver: ir.Model) -> None:
    relu, sigmoid, add = driver.graph
    provenance.stamp(relu, provenance.Provenance("backbone", ("r",)))
    provenance.stamp(sigmoid, provenance.Provenance("occ", ("s", "r"), ("fold",)))
    provenance.inherit(add, [sigmoid, relu], by="fuse")
    assert provenance.read(add) == provenance.Provenance(
        "occ", ("s", "r"), ("fold", "fuse")
    )


def test_a_node_without_a_past_is_named(driver: ir.Model) -> None:
    provenance.stamp(driver.graph[0], provenance.Provenance("backbone", ("r",)))
    assert provenance.missing(driver) == ["/occ_head/Sigmoid", "/plan_head/Add"]


def test_a_sweep_leaves_the_nodes_that_stay_as_they_are() -> None:
    model = ir.from_onnx_text(
        '<ir_version: 9, opset_import: ["" : 17]>\n'
        "m (float[1,2] x) => (float[1,2] y) <float[2] s, float[2] b> {\n"
        " dead = Neg(x)\n"
        " y = BatchNormalization<training_mode = 0>(x, s, b, b, s)\n}"
    )
    rewrite.sweep(model)
    (node,) = model.graph
    assert node.attributes.get_int("training_mode", 1) == 0
