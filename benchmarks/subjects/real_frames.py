"""Frames for trained networks of public packages, drawn by seed.

Each network is given what it was trained on, as near as a few lines come to it: a text
line or a page of them, speech of pulses through formants, the bytes of source files,
detectors that switch on and off. White noise would leave most of a trained network
silent, and ranges measured on it say nothing.
"""

import math
import sysconfig
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any, TypeAlias

import cv2
import numpy as np
import onnxruntime
from numpy.typing import NDArray

Array: TypeAlias = NDArray[Any]
Frame: TypeAlias = dict[str, Array]
Maker: TypeAlias = Callable[[Path, np.random.Generator], Iterator[Frame]]

RATE = 16_000
"""Samples of audio a second."""

WORDS = ("road", "merge", "yield", "signal", "stop", "north", "exit", "42 km", "Oslo")


def page(rng: np.random.Generator, height: int, width: int, lines: int) -> Array:
    """Draw a picture with text: float32 [1, 3, height, width], -1 to 1."""
    # a coloured ground that fades, and ink that differs from it
    fade = np.linspace(0, rng.uniform(-60, 60), width)[None, :, None]
    image = np.clip(rng.uniform(40, 255, 3) + fade, 0, 255) * np.ones((height, 1, 1))
    ink = (rng.uniform(0, 255, 3) / 3 + (170 if image.mean() < 128 else 0)).tolist()
    canvas = np.ascontiguousarray(image.astype(np.uint8))
    for line in range(lines):
        size = height / lines / 45 * rng.uniform(0.7, 1.1)
        text = " ".join(rng.choice(WORDS, 6))
        base = int((line + 0.7) * height / lines)
        start = int(rng.uniform(2, width / 6))
        face = (
            cv2.FONT_HERSHEY_SIMPLEX if rng.random() < 0.5 else cv2.FONT_HERSHEY_DUPLEX
        )
        cv2.putText(canvas, text, (start, base), face, size, ink, 1 + int(size > 0.8))
    # the camera: some blur, some noise
    blurred = cv2.GaussianBlur(canvas, (3, 3), rng.uniform(0.1, 1.2))
    noisy = np.clip(
        blurred + rng.normal(scale=rng.uniform(0, 8), size=image.shape), 0, 255
    )
    return (noisy / 127.5 - 1).transpose(2, 0, 1)[None].astype(np.float32)


def pages(height: int, width: int, lines: int) -> Maker:
    """Return a maker of pictures with text."""

    def make(_model: Path, rng: np.random.Generator) -> Iterator[Frame]:
        while True:
            turned = page(rng, height, width, lines)
            # a quarter upside down, as scanned by hand
            yield {
                "x": turned[:, :, ::-1, ::-1].copy() if rng.random() < 0.25 else turned
            }

    return make


def speech(rng: np.random.Generator, samples: int) -> Array:
    """Draw speech in noise: float32 [samples], -1 to 1, at 16 kHz."""
    time = np.arange(samples) / RATE
    # pulses whose pitch wanders, hiss beside them
    pitch = rng.uniform(90, 250) * (
        1 + 0.15 * np.sin(2 * math.pi * rng.uniform(0.3, 1) * time)
    )
    phase = np.cumsum(pitch) / RATE
    source = np.where(np.diff(np.floor(phase), prepend=0) > 0, 1.0, 0.0)
    source += 0.02 * rng.normal(size=samples)
    # three formants that change with every syllable
    spectrum = np.fft.rfft(source)
    hertz = np.fft.rfftfreq(samples, 1 / RATE)
    voice: Array = np.zeros(samples)
    syllables = np.repeat(rng.integers(0, 3, samples // 3200 + 1), 3200)[:samples]
    for vowel in range(3):
        gain: Array = np.zeros(len(hertz))
        for centre in rng.uniform((250, 900, 2200), (850, 2100, 3200)):
            gain += 1 / (1 + ((hertz - centre) / 90) ** 2)
        voice += np.fft.irfft(spectrum * gain, samples) * (syllables == vowel)
    # loudness by syllable, with pauses
    knots = rng.choice([0.0, 0.3, 1.0], samples // 2400 + 2, p=(0.35, 0.25, 0.4))
    voice *= np.interp(np.arange(samples), np.arange(len(knots)) * 2400, knots)
    voice *= rng.uniform(0.05, 0.7) / (np.abs(voice).max() + 1e-9)
    white = np.fft.rfft(rng.normal(size=samples))
    noise = np.fft.irfft(white / (1 + hertz / 800) ** rng.uniform(0, 1), samples)
    noise *= 10 ** rng.uniform(-4, -1) / noise.std()
    return np.clip(voice + noise, -1, 1).astype(np.float32)


def powers(audio: Array, size: int, hop: int) -> Array:
    """Return powers of a spectrum: float64 [frames, size // 2 + 1]."""
    padded: Array = np.pad(audio.astype(np.float64), (size // 2, size // 2))
    windows = np.lib.stride_tricks.sliding_window_view(padded, size)[::hop]
    power: Array = np.abs(np.fft.rfft(windows * np.hanning(size))) ** 2
    return power


def mels(audio: Array, bands: int, size: int, hop: int) -> Array:
    """Return a mel spectrum as speechmos scales it: float32 [frames, bands]."""
    power = powers(audio, size, hop)
    edges = 700 * (10 ** (np.linspace(0, 2840, bands + 2) / 2595) - 1)
    hertz = np.linspace(0, RATE / 2, power.shape[1])
    rising = (hertz - edges[:-2, None]) / np.diff(edges)[:-1, None]
    falling = (edges[2:, None] - hertz) / np.diff(edges)[1:, None]
    return in_decibels(power @ np.maximum(0, np.minimum(rising, falling)).T)


def in_decibels(power: Array) -> Array:
    """Return powers below the loudest, 40 dB to 1: float32."""
    decibels = 10 * np.log10(np.maximum(power, 1e-10))
    below = np.maximum(decibels - decibels.max(), -80)
    scaled: Array = ((below + 40) / 40).astype(np.float32)
    return scaled


def voice_activity(model: Path, rng: np.random.Generator) -> Iterator[Frame]:
    """Yield pieces of speech with the state that the network has reached there."""
    session = opened(model)
    ports = {port.name: port for port in session.get_inputs()}
    while True:
        audio = np.pad(speech(rng, 160 * 512), (64, 0))
        states = {
            name: zeros(port)
            for name, port in ports.items()
            if name not in ("input", "sr")
        }
        rows = 32 if "h" in ports else 1
        for place in range(0, len(audio) - 512 * rows - 64, 512 * rows):
            pieces = [audio[place + 512 * row :][:576] for row in range(rows)]
            frame = {"input": np.stack(pieces)} | states
            if "sr" in ports:
                frame["sr"] = np.array(RATE)
            _, *answers = run(session, frame)
            states = dict(zip(states, answers, strict=True))
            # neighbours are alike: four of a voice say as much
            if rows > 1 or place // 512 % 40 == 20:
                yield frame


def zeros(port: Any) -> Array:
    """Return zeros of an input's shape, open sizes 1: float32."""
    return np.zeros(
        [size if isinstance(size, int) else 1 for size in port.shape], np.float32
    )


def spectra(model: Path, rng: np.random.Generator) -> Iterator[Frame]:
    """Yield what speechmos gives its networks, by their names and shapes."""
    ports = {port.name: port.shape for port in opened(model).get_inputs()}
    first = next(iter(ports.values()))
    while True:
        if first[1:] == [144160]:
            yield {"input_1": speech(rng, 144160)[None]}
        elif "rater_embed" in ports:
            log = (
                np.log10(np.maximum(powers(speech(rng, 256 * 299), 512, 256), 1e-12))
                / 2
            )
            rater = rng.normal(size=(1, 64)).astype(np.float32)
            yield {
                "degraded_audio": log[None, None].astype(np.float32),
                "rater_embed": rater,
            }
        elif "h0" in ports:
            far, near = speech(rng, 256 * 299), speech(rng, 256 * 299)
            heard = near + 0.3 * np.roll(far, 800)
            signals = [mels(each, 160, 513, 256) for each in (far, heard, near)]
            yield {
                "input": np.stack(signals)[None],
                "h0": np.zeros(ports["h0"], np.float32),
            }
        elif first[2] == 161:
            yield {"input_1": in_decibels(powers(speech(rng, 144000), 320, 160))[None]}
        else:
            yield {"input_1": mels(speech(rng, 144000), 120, 321, 160)[None, :900]}


def file_bytes(_model: Path, rng: np.random.Generator) -> Iterator[Frame]:
    """Yield the first and last 1,024 bytes of files of the standard library."""
    library = Path(sysconfig.get_path("stdlib"))
    files = sorted(each for each in library.glob("*/*") if each.suffix in KINDS)
    while True:
        data = files[int(rng.integers(len(files)))].read_bytes().strip()
        ends = [list(data[:1024]), list(data[-1024:])]
        ends[0] += [256] * (1024 - len(ends[0]))
        ends[1] = [256] * (1024 - len(ends[1])) + ends[1]
        yield {"bytes": np.array([ends[0] + ends[1]], np.int32)}


KINDS = (
    ".py",
    ".txt",
    ".so",
    ".csv",
    ".html",
    ".json",
    ".wav",
    ".xml",
    ".c",
    ".zip",
    ".gif",
)


def rasters(rng: np.random.Generator, pairs: int) -> Array:
    """Draw signals and detectors, a second a step: float32 [pairs, 15, 1800]."""
    steps, raster = np.arange(1800), np.zeros((pairs, 15, 1800), np.float32)
    for pair in range(pairs):
        cycle, green = rng.uniform(60, 130), rng.uniform(0.2, 0.5)
        place = (steps / cycle + rng.random()) % 1
        shown = np.array([place < green, abs(place - green) < 0.04, place > green])
        waiting = place > rng.uniform(0.5, 0.9)
        passing = rng.random(1800) < np.where(shown[0], 0.4, rng.uniform(0, 0.3))
        rows = [
            passing,
            passing * rng.uniform(0, 1, 1800),
            *shown,
            waiting,
            *(shown[:2] / 2),
        ]
        raster[pair, : len(rows)] = rows
        raster[pair, 8:] = rng.random((7, 1800)) < 0.05
    return raster


def signal_pairs(_model: Path, rng: np.random.Generator) -> Iterator[Frame]:
    """Yield pairs of a detector and a phase."""
    while True:
        yield {"x": rasters(rng, 4)}


def signal_heads(model: Path, rng: np.random.Generator) -> Iterator[Frame]:
    """Yield what the network of pairs makes of a crossing: 6 detectors, 4 phases."""
    pair = opened(model.with_name(model.name.replace("_head", "_pair")))
    while True:
        logit, vectors = run(pair, {"x": rasters(rng, 24)})
        active = rng.uniform(0, 600, 6).astype(np.float32)
        yield {
            "logit": logit.reshape(6, 4),
            "Z": vectors.reshape(6, 4, 128),
            "act": active,
        }


def run(session: onnxruntime.InferenceSession, frame: Frame) -> list[Any]:
    """Run one frame; return all outputs."""
    return list(session.run(None, frame))


def opened(model: Path) -> onnxruntime.InferenceSession:
    """Open a network as it stands: no optimization, one thread."""
    options = onnxruntime.SessionOptions()
    options.graph_optimization_level = (
        onnxruntime.GraphOptimizationLevel.ORT_DISABLE_ALL
    )
    options.intra_op_num_threads, options.log_severity_level = 1, 4
    return onnxruntime.InferenceSession(
        model, options, providers=["CPUExecutionProvider"]
    )


MAKERS: Mapping[str, Maker] = {
    "PP-OCRv4_det": pages(320, 320, 6),
    "PP-OCRv4_rec": pages(48, 320, 1),
    "mobile_v2.0_cls": pages(48, 192, 1),
    "silero": voice_activity,
    "magika": file_bytes,
    "speechmos": spectra,
    "_pair.onnx": signal_pairs,
    "_head.onnx": signal_heads,
}
"""How frames are made, by a part of the file's path."""
