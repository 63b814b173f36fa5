"""Frames of a study that records its own."""

from dataclasses import replace
from pathlib import Path

from me2e_compress.study.definition import Study
from me2e_compress.study.workspace import Workspace
from me2e_compress.workflows.frames import FramesOptions, record_frames
from me2e_compress.workflows.listener import Listener


def recorded(study: Study, workspace: Workspace, listener: Listener) -> Study:
    """Return the study with folders of frames, recorded unless they exist.

    The held-out frames use the next seed, hence other routes.
    """
    asked = study.to_record
    if asked is None:
        return study
    model = Path(study.reference.policy)
    # calibration frames, and held-out frames of the next seed
    folders = list[Path]()
    for name, count, seed in (
        ("frames", asked.frames, asked.seed),
        ("frames-held-out", asked.held_out, asked.seed + 1),
    ):
        folder = workspace.folder / name
        if not (folder / "scenes.json").is_file():
            folder.parent.mkdir(parents=True, exist_ok=True)
            options = FramesOptions(count, seed, provider=study.provider)
            record_frames(model, folder, options, listener)
        folders.append(folder)
    frames, held_out = folders
    return replace(study, frames=frames, held_out=held_out, to_record=None)
