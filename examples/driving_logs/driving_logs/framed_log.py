"""Frames of an ONNX file, from the moments of a data set."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass

from driving_logs.adapted_inputs import AdaptedInputs
from driving_logs.model_forms import inputs_of_model
from driving_logs.model_inputs import LoggedInputs, log_frames
from driving_logs.moments import CameraLog
from me2e_compress.calibration.dataset import PixelInput
from me2e_compress.calibration.recording import Begin, LogRequest
from me2e_compress.driving.adapter import Adapter
from me2e_compress.driving.onnx_policy import OnnxPolicy
from me2e_compress.runtime.frames import Frame


@dataclass(frozen=True, kw_only=True)
class FramedLog(CameraLog):
    """A data set whose moments are laid out as a file, or its adapter, takes them."""

    def frames(self, request: LogRequest, begin: Begin) -> Iterator[Frame]:
        """Yield the frames from a scene on; images are bytes, but with an adapter."""
        log: CameraLog = self
        model: AdaptedInputs | LoggedInputs
        if request.adapter is None:
            model = inputs_of_model(request.model, self.size)
        else:
            adapter = Adapter.load(request.adapter)
            model = AdaptedInputs(
                OnnxPolicy.open(request.model, adapter, request.provider)
            )
            log = model.log_for(self)
        yield from log_frames(
            log,
            model,
            request.count,
            request.scene_length,
            done=begin.frame,
            first=begin.place,
        )

    def pixels(self, request: LogRequest) -> Mapping[str, PixelInput]:
        """Return how the bytes of the image become the input."""
        if request.adapter is not None:
            return {}
        image = inputs_of_model(request.model, self.size).image
        return {} if image is None else {"img": image}
