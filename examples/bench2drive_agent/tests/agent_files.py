"""Models that drive, and the options of an agent."""

import json
from pathlib import Path

import onnx


def straight_on(
    path: Path,
    *,
    inputs: str = "int64[1] command",
    body: str = "plan = Identity (ahead)",
    outputs: str = "float[1, 6, 2] plan",
    initializers: str = "",
    metadata: dict[str, str] | None = None,
) -> Path:
    """Write a model; its default plan goes 4 m/s straight ahead."""
    ahead = ", ".join(f"{2.0 * k}, 0.0" for k in range(1, 7))
    text = f"""<ir_version: 8, opset_import: ["" : 17]>
    driver ({inputs}) => ({outputs})
    <float[1, 6, 2] ahead = {{{ahead}}} {initializers}> {{ {body} }}"""
    model = onnx.parser.parse_model(text)
    for key, value in (metadata or {}).items():
        model.metadata_props.add(key=key, value=value)
    onnx.save(model, path)
    return path


def options(model: Path, adapter: str = "", **others: object) -> str:
    """Write the options of an agent beside its model; an adapter is TOML text."""
    given: dict[str, object] = {
        "model": str(model),
        "folder": str(model.parent / "saved"),
        "latency": "none",
        **others,
    }
    if adapter:
        path = model.with_name("adapter.toml")
        path.write_text(adapter, encoding="utf-8")
        given["adapter"] = str(path)
    path = model.with_name("agent.toml")
    lines = [f"{name} = {json.dumps(value)}" for name, value in given.items()]
    path.write_text("\n".join(lines), encoding="utf-8")
    return str(path)
