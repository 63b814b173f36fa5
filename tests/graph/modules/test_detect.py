import onnx_ir as ir
import pytest

from me2e_compress.base.errors import ModuleMapError
from me2e_compress.graph.modules.assign import detect


def chain(*scopes: str, **props: str) -> ir.Model:
    body = " ".join(
        f'["/{scope}/Relu"] v{index + 1} = Relu(v{index})'
        for index, scope in enumerate(scopes)
    )
    model = ir.from_onnx_text(
        '<ir_version: 8, opset_import: ["": 17]>'
        f" g (float[2] v0) => (float[2] v{len(scopes)}) {{ {body} }}"
    )
    model.metadata_props.update(props)
    return model


def test_the_metadata_decides() -> None:
    for stack, name in (("vad-tiny", "vad"), ("vad", "vad"), ("highway", "highway")):
        assert detect(chain("motion_head", **{"me2e.stack": stack})).name == name


@pytest.mark.parametrize(
    ("scopes", "name"),
    [
        (
            "img_backbone img_neck pts_bbox_head/transformer/encoder"
            " pts_bbox_head/map_cls_branches.0 pts_bbox_head/ego_map_decoder",
            "vad",
        ),
        (
            "img_backbone img_neck encoder/layers.0 decoder/layers.0 seg_head"
            " motion_head planning_head",
            "uniad",
        ),
        ("perception measurements join_traj wp_att", "tcp"),
        ("backbone/stem neck bev_encoder map planner", "highway"),
    ],
)
def test_otherwise_the_names_do(scopes: str, name: str) -> None:
    assert detect(chain(*scopes.split())).name == name


def test_an_unknown_stack_falls_back_on_names() -> None:
    with pytest.raises(ModuleMapError, match=r"no module map fits .* give a map file"):
        detect(chain("layer1", "fc", **{"me2e.stack": "vadinci"}))
