"""The models that int8 is measured on, each with frames and a module map, in a folder.

* ``resnet50``: a classifier, 224 x 224.
* ``bev-head``: see :mod:`benchmarks.subjects.bev_head`.
* ``vad-tiny``: the reference stack.
* ``vad-tiny-original``: the same, see :mod:`benchmarks.subjects.original_patterns`.
* ``uniad-tiny``, ``tcp``, ``lead``: other stacks of models/.
* ``tcp-original``: with all eight outputs, see :mod:`benchmarks.subjects.original_tcp`.
* ``highway``: the driver that ships; its frames need the extra ``highway``.
* the models of :mod:`benchmarks.subjects.model_kinds`, which need transformers.

The model in the folder is what ``quantize-int8`` sees: the exact passes are done.
"""

import json
import shutil
from pathlib import Path

import numpy as np

from benchmarks.subjects import bev_head, original_patterns, original_tcp, resnet50
from benchmarks.subjects.subject import Subject, at
from me2e_compress import graph
from me2e_compress.commands.compress import compress
from me2e_compress.commands.files import export_stack
from me2e_compress.commands.frames import record_frames
from me2e_compress.commands.options import CompressOptions, FramesOptions
from me2e_compress.shipped.drivers import SHIPPED
from models.export import export
from models.frames import record

__all__ = ["SUBJECTS", "Subject", "at", "make"]

ORIGINALS = {each.NAME: each for each in (original_patterns, original_tcp)}
"""Stacks of models/ in the forms of the published code."""
PRESETS = {
    "vad-tiny": "vad",
    "vad-tiny-original": "vad",
    "uniad-tiny": "uniad",
    "tcp": "tcp",
    "tcp-original": "tcp",
    "highway": "highway",
}
"""Module maps of the stacks of models/."""
WITHOUT_PRESET = ("lead",)
"""Stacks of models/ that are one module."""
SUBJECTS = ("resnet50", "bev-head", *PRESETS, *WITHOUT_PRESET)
WHOLE = """
[modules.network]
role = "feature"
optional = ["*"]
"""
HELD_OUT = 4
SCENE = 4
"""Frames a scene, where frames follow each other."""


def make(name: str, out: Path, frames: int, held_out: int = HELD_OUT) -> Subject:
    """Write a subject, unless it is there with as many frames."""
    subject = Subject(name, out / name)
    if name not in SUBJECTS:
        return _make_kind(subject)
    subject.folder.mkdir(parents=True, exist_ok=True)
    if not subject.model.is_file():
        _export(subject)
    recordings = (subject.frames, frames, 0), (subject.held_out, held_out, 1)
    for folder, count, seed in recordings:
        if len(list(folder.glob("*.npz"))) < count:
            shutil.rmtree(folder, ignore_errors=True)
            _record(name, folder, count, seed)
    return subject


def write_source(name: str, path: Path) -> None:
    """Write a driver that ships, or a stack of models/."""
    if name in SHIPPED:
        export_stack(name, path)
    else:
        export(name, path)


def write_frames(name: str, folder: Path, count: int, seed: int) -> None:
    """Record frames of a driver that ships, or of a stack of models/."""
    if name in SHIPPED:
        record_frames(
            name, folder, FramesOptions(count=count, seed=seed, scene_length=SCENE)
        )
    else:
        record(name, folder, count, seed=seed, scene_length=SCENE)


def _make_kind(subject: Subject) -> Subject:
    """Write a model of another kind; one module holds all of it."""
    from benchmarks.subjects import model_kinds

    model_kinds.make(subject.name, subject.folder.parent)
    subject.map.write_text(WHOLE, encoding="utf-8")
    if not subject.model.is_file():
        unchecked = CompressOptions(module_map=subject.map, verify_frames=0)
        compress(subject.source, subject.model, "exact", options=unchecked)
    return subject


def _export(subject: Subject) -> None:
    if subject.name in PRESETS:
        if subject.name in ORIGINALS:
            ORIGINALS[subject.name].export(subject.source)
        else:
            write_source(subject.name, subject.source)
        preset = f"modules/presets/{PRESETS[subject.name]}.toml"
        text = (Path(graph.__file__).parent / preset).read_text("utf-8")
    elif subject.name in WITHOUT_PRESET:
        write_source(subject.name, subject.source)
        text = WHOLE
    else:
        maker = {"resnet50": resnet50, "bev-head": bev_head}[subject.name]
        maker.export(subject.source)
        text = maker.MAP
    subject.map.write_text(text, encoding="utf-8")
    unchecked = CompressOptions(module_map=subject.map, verify_frames=0)
    compress(subject.source, subject.model, "exact", options=unchecked)


def _record(name: str, folder: Path, count: int, seed: int) -> None:
    if name in (*PRESETS, *WITHOUT_PRESET):
        stack = ORIGINALS[name].OF if name in ORIGINALS else name
        write_frames(stack, folder, count, seed)
    elif name == "bev-head":
        bev_head.record(folder, count, seed)
    else:
        folder.mkdir(parents=True)
        for index, image in enumerate(resnet50.images(count, seed)):
            np.savez(folder / f"{index:06d}.npz", image=image)
        scenes = json.dumps({"scenes": list(range(count))})
        (folder / "scenes.json").write_text(scenes)
