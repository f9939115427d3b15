"""Flights with frames after processing that the image model does not know.

Usage: python -m benchmarks.accuracy.processed FLIGHT... [--only median] [--jobs 2]

Each kind of processing is applied to the frames of a flight, and their response is then declared
unknown. The lines are those of `benchmarks.accuracy.flights`. They show whether the reported
standard deviations remain right, and whether targets that cannot be measured are rejected. Video
needs PyAV (`pip install av`), and is left out without it.
"""

from __future__ import annotations

import importlib
import importlib.util
import io
import re
import shutil
import tempfile
from collections.abc import Callable, Mapping
from pathlib import Path

import click
import cv2
import numpy as np
import numpy.typing as npt

from benchmarks.accuracy.bands import join_truth, read_truth
from benchmarks.accuracy.evaluate import detect
from benchmarks.accuracy.flights import HEADER, line_of, truth_path, with_sides
from kgcp.io.flight.flight import read_flight
from kgcp.io.images.frames import list_frames
from kgcp.pipeline.execution.resilient_map import usable_cores
from kgcp.settings import DetectSettings

Pixels = npt.NDArray[np.uint8]  # (rows, columns) or (rows, columns, 3)
_COMPRESSIONS = {"JPEG 70": 70, "JPEG 40": 40}  # name → quality
_QUALITY = 95  # of the JPEGs of other processings
_STUCK_SHARE, _SEED = 0.001, 3  # share of stuck pixels
_VIDEO_RATE_FACTOR = "18"  # of x264; 23 is its default, and gives half the size
_VIDEO_FRAMES = 13  # half a second; one of them is taken for the flight
_MOTION_PX = np.array([3.37, -1.81])  # of the image between two frames of a video
_VIDEO_NOISE = 1.5  # standard deviation [grey values], new in every frame


def _rounded(values: npt.NDArray[np.floating]) -> Pixels:
    return np.asarray(np.clip(np.rint(values), 0.0, 255.0), np.uint8)


def _with_stuck_pixels(pixels: Pixels, value: int) -> Pixels:
    """Return the frame with a thousandth of its pixels stuck at a value."""
    changed = pixels.copy()
    changed[np.random.default_rng(_SEED).random(pixels.shape[:2]) < _STUCK_SHARE] = value
    return changed


def _for_colours(pixels: Pixels, values: npt.NDArray[np.floating]) -> npt.NDArray[np.floating]:
    """Return values of rows (rows, 1) or columns (1, columns), broadcastable to all colours."""
    return values[..., None] if pixels.ndim > values.ndim else values


def _with_flicker(pixels: Pixels) -> Pixels:
    """Return the frame with the bands of a flickering lamp: ± 2 % with a period of 44 rows."""
    flicker = 1.0 + 0.02 * np.sin(np.arange(len(pixels))[:, None] / 7.0)
    return _rounded(pixels * _for_colours(pixels, flicker))


def _with_column_noise(pixels: Pixels) -> Pixels:
    """Return the frame with a random offset of each column, σ = 2 grey values."""
    offsets = np.random.default_rng(_SEED).normal(0.0, 2.0, (1, pixels.shape[1]))
    return _rounded(pixels + _for_colours(pixels, offsets))


def _enlarged(pixels: Pixels) -> Pixels:
    """Return the frame after reduction to half its size and enlargement to its original size."""
    height, width = pixels.shape[:2]
    half = cv2.resize(pixels, (width // 2, height // 2), interpolation=cv2.INTER_AREA)
    return np.asarray(cv2.resize(half, (width, height), interpolation=cv2.INTER_CUBIC), np.uint8)


def _contrast_by_tiles(pixels: Pixels) -> Pixels:
    """Return the frame with the histograms of its tiles stretched (CLAHE)."""
    stretch = cv2.createCLAHE(2.0, (8, 8)).apply
    layers = [stretch(np.ascontiguousarray(layer)) for layer in np.atleast_3d(pixels).T]
    return np.asarray(np.stack(layers).T.reshape(pixels.shape), np.uint8)


def _with_unsharp_mask(pixels: Pixels, sigma_px: float, strength: float) -> Pixels:
    """Return the frame with an unsharp mask: `strength` times its difference to a blurred copy."""
    blurred = cv2.GaussianBlur(pixels.astype(np.float32), (0, 0), sigma_px)
    return _rounded(pixels + strength * (pixels - blurred))


def _interlaced(pixels: Pixels) -> Pixels:
    """Return the frame with every second row displaced by 2 px."""
    changed = pixels.copy()
    changed[1::2] = np.roll(pixels, 2, axis=1)[1::2]
    return changed


def _moved(pixels: Pixels, frames: int, rng: np.random.Generator) -> Pixels:
    """Return what a video shows some frames later, while its camera moves evenly."""
    height, width = pixels.shape[:2]
    shift = np.column_stack([np.eye(2), frames * _MOTION_PX])
    moved = cv2.warpAffine(
        pixels, shift, (width, height), flags=cv2.INTER_CUBIC, borderMode=cv2.BORDER_REFLECT
    )
    return _rounded(moved + rng.normal(0.0, _VIDEO_NOISE, moved.shape))


def _from_video(pixels: Pixels, number: int) -> Pixels:
    """Return the frame as H.264 keeps it as a video's frame of a number from 0 upwards.

    Frame 0 is a key frame, compressed on its own. The blocks of the others are copied from frames
    before them with a displacement, and only larger differences are stored.
    """
    av = importlib.import_module("av")
    height, width = pixels.shape[:2]
    rng = np.random.default_rng(_SEED)
    file = io.BytesIO()
    with av.open(file, "w", format="mp4") as video:
        stream = video.add_stream("libx264", rate=25)
        stream.width, stream.height, stream.pix_fmt = width, height, "yuv420p"
        stream.options = {"crf": _VIDEO_RATE_FACTOR}
        for shown in range(_VIDEO_FRAMES):
            grey = pixels if shown == number else _moved(pixels, shown - number, rng)
            colours = grey if grey.ndim == 3 else cv2.cvtColor(grey, cv2.COLOR_GRAY2BGR)
            video.mux(stream.encode(av.VideoFrame.from_ndarray(colours, format="bgr24")))
        video.mux(stream.encode())
    file.seek(0)
    with av.open(file) as video:
        decoded = list(video.decode(video=0))[number].to_ndarray(format="bgr24")
    return np.asarray(decoded if pixels.ndim == 3 else decoded[..., 1], np.uint8)


_VIDEOS: Mapping[str, Callable[[Pixels], Pixels]] = {
    "key frames": lambda pixels: _from_video(pixels, 0),
    "video frames": lambda pixels: _from_video(pixels, _VIDEO_FRAMES - 1),
}
PROCESSINGS: Mapping[str, Callable[[Pixels], Pixels]] = {
    "as it is": lambda pixels: pixels,
    "hot pixels": lambda pixels: _with_stuck_pixels(pixels, 255),
    "dead pixels": lambda pixels: _with_stuck_pixels(pixels, 0),
    "flicker": _with_flicker,
    "column noise": _with_column_noise,
    "32 grey values": lambda pixels: _rounded(8.0 * np.rint(pixels / 8.0)),
    "haze": lambda pixels: _rounded(0.3 * pixels + 120.0),
    "gamma": lambda pixels: _rounded(255.0 * np.sqrt(pixels / 255.0)),
    "median": lambda pixels: np.asarray(cv2.medianBlur(pixels, 3), np.uint8),
    "bilateral": lambda pixels: np.asarray(cv2.bilateralFilter(pixels, 7, 25.0, 3.0), np.uint8),
    "enlarged": _enlarged,
    "sharpened": lambda pixels: _with_unsharp_mask(pixels, 2.0, 1.5),
    "local contrast": lambda pixels: _with_unsharp_mask(pixels, 15.0, 0.5),
    "CLAHE": _contrast_by_tiles,
    **dict.fromkeys(_COMPRESSIONS, lambda pixels: pixels),
    "interlaced": _interlaced,
    **(_VIDEOS if importlib.util.find_spec("av") else {}),
}
"""Functions of the pixels of a frame, by the name of the processing.

JPEG compression takes place when the frame is written."""


def process_flight(flight: Path, name: str, out: Path) -> None:
    """Write a flight with processed frames and an unknown response into a folder."""
    frames = read_flight(flight).frames_folder
    shutil.copytree(flight, out, copy_function=shutil.copyfile)
    settings = out / "flight.toml"
    settings.write_text(
        re.sub(r"(?m)^response = .*$", 'response = "unknown"', settings.read_text("utf-8")), "utf-8"
    )
    quality = _COMPRESSIONS.get(name, _QUALITY)
    for frame in list_frames(frames):
        pixels = cv2.imread(str(frames / frame), cv2.IMREAD_UNCHANGED)
        if pixels is None or pixels.dtype != np.uint8:
            raise click.UsageError(f"{frames / frame}: does not have 8 bits")
        is_jpeg = name in _COMPRESSIONS or Path(frame).suffix.lower() in {".jpg", ".jpeg"}
        _, encoded = cv2.imencode(
            ".jpg" if is_jpeg else ".png",
            PROCESSINGS[name](pixels.astype(np.uint8)),
            [cv2.IMWRITE_JPEG_QUALITY, quality] if is_jpeg else [],
        )
        (out / frames.relative_to(flight) / frame).write_bytes(encoded.tobytes())


@click.command()
@click.argument("flights", nargs=-1, required=True, type=click.Path(path_type=Path))
@click.option("--only", type=click.Choice(list(PROCESSINGS)), multiple=True)
@click.option("--jobs", type=click.IntRange(1, 256), default=None)
def main(flights: tuple[Path, ...], only: tuple[str, ...], jobs: int | None) -> None:
    """Print a table for each flight."""
    for flight in flights:
        truth = read_truth(truth_path(flight))
        print(f"{flight}\n{HEADER}", flush=True)
        for name in only or PROCESSINGS:
            with tempfile.TemporaryDirectory(prefix="kgcp_processed_") as folder:
                out = Path(folder) / "flight"
                process_flight(flight, name, out)
                found = detect(out, DetectSettings(), jobs or usable_cores())
                table = with_sides(read_flight(out), join_truth(found, truth))
                print(line_of(name, table), flush=True)


if __name__ == "__main__":
    main()
