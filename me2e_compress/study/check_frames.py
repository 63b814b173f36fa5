"""The frames of a study, looked at before anything runs."""

from me2e_compress.calibration.dataset import CalibrationSet
from me2e_compress.errors import FramesError, StudyError
from me2e_compress.study.definition import Study


def check_recordings(study: Study) -> None:
    """Open the recordings that a study names.

    Raises:
        StudyError: One of them is none.
    """
    for name, folder in (("frames", study.frames), ("held_out", study.held_out)):
        if folder is None:
            continue
        try:
            CalibrationSet(folder)
        except FramesError as error:
            raise StudyError(f"{name}: {error}") from error
