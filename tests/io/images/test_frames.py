from __future__ import annotations

import os
import struct
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from PIL import Image

from kgcp.errors import KgcpError, KgcpWarning, Reason, Rejection
from kgcp.geometry.arrays import GreyArray
from kgcp.geometry.camera import Camera
from kgcp.io.images.frames import list_frames, read_grey
from tests.systems import not_on_windows

WIDTH, HEIGHT = 320, 200
CAMERA = Camera(width=WIDTH, height=HEIGHT, fx=400.0, fy=401.0, cx=160.0, cy=99.0)


def textured(dtype: type[np.unsignedinteger[Any]] = np.uint8, channels: int = 1) -> GreyArray:
    rng = np.random.default_rng(5)
    shape = (HEIGHT, WIDTH) if channels == 1 else (HEIGHT, WIDTH, channels)
    noise = cv2.GaussianBlur(rng.uniform(0.0, 1.0, shape), (0, 0), 1.5)
    return np.asarray(noise * np.iinfo(dtype).max).astype(dtype)


def encoded(image: GreyArray, suffix: str, *options: int) -> bytes:
    done, data = cv2.imencode(suffix, image, list(options))
    assert done
    return data.tobytes()


def tiff(pixels: bytes, bits: int, photometric: int, samples: int, **tags: int) -> bytes:
    """Return an uncompressed TIFF of one strip; planes=2 stores channels one after the other."""
    depth = struct.pack(f"<{samples}H", *[bits] * samples)
    entries = {256: (4, 1, WIDTH), 257: (4, 1, HEIGHT), 262: (3, 1, photometric)}
    entries |= {277: (3, 1, samples), 278: (4, 1, HEIGHT)}
    entries |= {284: (3, 1, tags.get("planes", 1))}
    if "opacity" in tags:
        entries[338] = (3, 1, tags["opacity"])
    strips = samples if tags.get("planes") == 2 else 1
    place = 8 + 2 + 12 * (len(entries) + 3) + 4
    sizes = struct.pack(f"<{strips}I", *[len(pixels) // strips] * strips)
    first = place + len(depth) + 2 * len(sizes)
    places = struct.pack(f"<{strips}I", *range(first, first + len(pixels), len(pixels) // strips))
    entries[258] = (3, samples, place if samples > 2 else bits * 65537)
    entries[273] = (4, strips, place + len(depth) if strips > 1 else first)
    entries[279] = (4, strips, place + len(depth) + len(sizes) if strips > 1 else len(pixels))
    directory = b"".join(struct.pack("<HHII", tag, *entries[tag]) for tag in sorted(entries))
    head = b"II*\0" + struct.pack("<IH", 8, len(entries)) + directory + bytes(4)
    return head + depth + places + sizes + pixels


def rejection(path: Path) -> Rejection:
    with pytest.raises(Rejection) as caught:
        read_grey(path, CAMERA)
    return caught.value


class TestListFrames:
    def test_walks_folders_and_sorts_by_relative_name(self, tmp_path: Path) -> None:
        names = ["b/2.PNG", "b/1.tiff", "a.JPG", "c.jpeg", "b/deep/er/3.Bmp", "z.TIF"]
        for name in [*names, "notes.txt", ".hidden.jpg", ".trash/x.jpg", "b/._2.png", "jpg"]:
            path = tmp_path / name
            path.parent.mkdir(parents=True, exist_ok=True)
            path.touch()
        assert list_frames(tmp_path) == sorted(names)

    def test_frames_and_results_of_a_flight_within_this_one_are_left_out(
        self, tmp_path: Path
    ) -> None:
        """A sheet with a perfect target among the results would be measured, too."""
        others = ["b/2.jpg", "b/frames/c/3.jpg", "b/kgcp/targets/target_A.png"]
        for name in ["1.jpg", "a/1.jpg", "flight.toml", "kgcp/x.png", "b/flight.toml", *others]:
            path = tmp_path / name
            path.parent.mkdir(parents=True, exist_ok=True)
            path.touch()
        with pytest.warns(KgcpWarning, match="leaves out 3 images in b, which is another flight"):
            assert list_frames(tmp_path) == ["1.jpg", "a/1.jpg"]
        assert list_frames(tmp_path / "b") == ["2.jpg", "frames/c/3.jpg"]

    def test_an_empty_folder_is_an_error(self, tmp_path: Path) -> None:
        with pytest.raises(KgcpError, match=r"holds no images; .*\[frames\] folder"):
            list_frames(tmp_path)

    def test_files_of_another_kind_are_named(self, tmp_path: Path) -> None:
        for name in ("1.DNG", "2.dng", "notes.txt", ".hidden.heic"):
            (tmp_path / name).touch()
        with pytest.raises(
            KgcpError, match=r"no images that kgcp reads, but 2 \.dng raw files; dev"
        ):
            list_frames(tmp_path)

    def test_a_missing_folder_is_an_error(self, tmp_path: Path) -> None:
        with pytest.raises(KgcpError, match=r"nowhere: is not a folder; .*\[frames\] folder"):
            list_frames(tmp_path / "nowhere")

    @not_on_windows("has no such names")
    def test_a_name_that_no_table_can_hold_is_an_error(self, tmp_path: Path) -> None:
        Path(os.fsdecode(bytes(tmp_path) + b"/\xff.jpg")).touch()
        with pytest.raises(KgcpError, match=r"not UTF-8; rename") as caught:
            list_frames(tmp_path)
        assert str(caught.value).encode()


class TestReadGrey:
    @pytest.mark.parametrize("suffix", [".png", ".tif", ".bmp", ".pgm"])
    def test_eight_bits_are_kept(self, tmp_path: Path, suffix: str) -> None:
        image = textured()
        path = tmp_path / f"frame{suffix}"
        path.write_bytes(encoded(image, suffix))
        grey = read_grey(path, CAMERA)
        assert grey.dtype == np.uint8
        np.testing.assert_array_equal(grey, image)

    @pytest.mark.parametrize("suffix", [".png", ".tif"])
    def test_sixteen_bits_are_kept(self, tmp_path: Path, suffix: str) -> None:
        image = textured(np.uint16)
        path = tmp_path / f"frame{suffix}"
        path.write_bytes(encoded(image, suffix))
        grey = read_grey(path, CAMERA)
        assert grey.dtype == np.uint16
        np.testing.assert_array_equal(grey, image)

    @pytest.mark.parametrize("channels", [3, 4])
    @pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
    def test_colour_and_alpha_become_luma(
        self, tmp_path: Path, dtype: type[np.unsignedinteger[Any]], channels: int
    ) -> None:
        image = textured(dtype, channels)
        path = tmp_path / "frame.png"
        path.write_bytes(encoded(image, ".png"))
        grey = read_grey(path, CAMERA)
        luma = image[..., :3] @ np.array([0.114, 0.587, 0.299])  # BGR, ITU-R BT.601
        assert grey.dtype == dtype
        np.testing.assert_allclose(grey, luma, atol=2e-4 * np.iinfo(dtype).max + 1.0)

    @pytest.mark.parametrize("is_big", [False, True])
    @pytest.mark.parametrize("orientation", range(1, 9))
    def test_the_orientation_tag_of_a_tiff_is_not_applied(
        self, tmp_path: Path, orientation: int, *, is_big: bool
    ) -> None:
        image = textured()
        path = tmp_path / "frame.tif"
        Image.fromarray(image).save(path, tiffinfo={274: orientation}, big_tiff=is_big)
        np.testing.assert_array_equal(read_grey(path, CAMERA), image)

    def test_the_orientation_tag_is_not_applied(self, tmp_path: Path) -> None:
        image = textured()
        path = tmp_path / "turned.png"
        exif = Image.Exif()
        exif[0x0112] = 6  # "rotate by 90 degrees to show"
        Image.fromarray(image).save(path, exif=exif)
        np.testing.assert_array_equal(read_grey(path, CAMERA), image)

    @pytest.mark.parametrize("progressive", [0, 1])
    def test_a_whole_jpeg_passes(self, tmp_path: Path, progressive: int) -> None:
        image = textured()
        path = tmp_path / "frame.jpg"
        data = encoded(image, ".jpg", cv2.IMWRITE_JPEG_PROGRESSIVE, progressive)
        path.write_bytes(data + b"whatever a camera appends")
        assert np.std(read_grey(path, CAMERA).astype(float) - image) < 3.0

    @pytest.mark.parametrize("progressive", [0, 1])
    @pytest.mark.parametrize("damage", ["cut", "cut and ended", "short by 40", "zeroed"])
    def test_a_damaged_jpeg_is_rejected_without_output_of_the_decoder(
        self, tmp_path: Path, capfd: pytest.CaptureFixture[str], damage: str, progressive: int
    ) -> None:
        data = encoded(textured(), ".jpg", cv2.IMWRITE_JPEG_PROGRESSIVE, progressive)
        middle = len(data) // 2
        path = tmp_path / "frame.jpg"
        path.write_bytes(
            {
                "cut": data[:middle],
                "cut and ended": data[:middle] + b"\xff\xd9",
                "short by 40": data[:-40],
                "zeroed": data[:middle] + bytes(2000) + data[middle + 2000 :],
            }[damage]
        )
        assert rejection(path).reason is Reason.DECODE_FAILED
        assert capfd.readouterr() == ("", "")

    def test_a_jpeg_of_complete_pixels_passes(self, tmp_path: Path) -> None:
        data = encoded(textured(), ".jpg")
        path = tmp_path / "frame.jpg"
        path.write_bytes(data)
        whole = read_grey(path, CAMERA)
        scan = data.index(b"\xff\xda")
        pixels = scan + 2 + int.from_bytes(data[scan + 2 : scan + 4])
        odd = data[: pixels - 3] + b"\5\5\5" + data[pixels:]  # only progressive ones have these
        for harmless in (data[:-2], odd):
            path.write_bytes(harmless)
            np.testing.assert_array_equal(read_grey(path, CAMERA), whole)

    def test_a_jpeg_that_the_decoder_gives_up_is_rejected(self, tmp_path: Path) -> None:
        data = encoded(textured(), ".jpg")
        middle = len(data) // 2
        path = tmp_path / "frame.jpg"
        path.write_bytes(data[:middle] + b"\xff\x02" + data[middle:])
        assert rejection(path).detail.startswith("Unsupported marker type")

    def test_cmyk_jpegs_are_checked_for_damage_too(self, tmp_path: Path) -> None:
        path = tmp_path / "frame.jpg"
        image = textured(channels=3)
        Image.fromarray(image).convert("CMYK").save(path, quality=95)
        luma = image @ np.array([0.299, 0.587, 0.114])
        assert np.abs(read_grey(path, CAMERA) - luma).mean() < 2.0
        data = path.read_bytes()
        path.write_bytes(data[: len(data) // 2] + b"\xff\xd9")
        assert rejection(path).detail.startswith("Corrupt JPEG data")

    @pytest.mark.parametrize("suffix", [".png", ".tif", ".bmp", ".webp", ".jp2"])
    def test_other_damaged_images_are_rejected_without_output_of_the_decoder(
        self, tmp_path: Path, capfd: pytest.CaptureFixture[str], suffix: str
    ) -> None:
        image = textured(channels=3)
        path = tmp_path / f"frame{suffix}"
        path.write_bytes(encoded(image, suffix)[:-1000])
        assert rejection(path).reason is Reason.DECODE_FAILED
        assert capfd.readouterr() == ("", "")

    @pytest.mark.skipif(sys.platform != "linux", reason="counts memory as Linux does")
    def test_a_png_takes_no_more_memory_than_it_has_bytes(self) -> None:
        """A chunk of an animated PNG states a length of 2 GB, which some decoders allocate."""
        path = Path(__file__).parents[3] / "fuzz/found/frames/long_chunk.png"
        script = """
import resource, sys
from pathlib import Path
from kgcp.errors import Rejection
from kgcp.geometry.camera import Camera
from kgcp.io.images.frames import read_grey
before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
try:
    read_grey(Path(sys.argv[1]), Camera(40, 30, 50.0, 50.0, 20.0, 15.0))
except Rejection as rejection:
    print(rejection.reason, resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before)
"""
        ran = subprocess.run(
            [sys.executable, "-c", script, path], check=True, capture_output=True, text=True
        )
        reason, kilobytes = ran.stdout.split()
        assert reason == Reason.DECODE_FAILED
        assert int(kilobytes) < 100_000

    @pytest.mark.parametrize("content", [b"", b"\xff", b"no image at all\n" * 50])
    def test_a_file_that_is_no_image_is_rejected(self, tmp_path: Path, content: bytes) -> None:
        path = tmp_path / "text.jpg"
        path.write_bytes(content)
        caught = rejection(path)
        assert caught.reason is Reason.DECODE_FAILED
        assert f"{len(content)} bytes" in caught.detail

    def test_a_frame_that_vanished_is_rejected(self, tmp_path: Path) -> None:
        assert rejection(tmp_path / "gone.jpg").reason is Reason.DECODE_FAILED

    def test_floating_point_is_rejected(self, tmp_path: Path) -> None:
        path = tmp_path / "float.tif"
        path.write_bytes(encoded(textured().astype(np.float32), ".tif"))
        assert "float32" in rejection(path).detail

    @pytest.mark.parametrize(
        ("photometric", "channels", "planes", "said"),
        [
            (0, 1, 1, "16 bits with white as 0"),
            (2, 3, 2, "separate planes of 16 bits"),
            (1, 2, 1, "16 bits that are neither grey nor RGB"),
        ],
    )
    def test_a_tiff_that_the_decoder_would_misread_is_rejected(
        self, tmp_path: Path, photometric: int, channels: int, planes: int, said: str
    ) -> None:
        pixels = b"".join([textured(np.uint16).tobytes()] * channels)
        path = tmp_path / "frame.tif"
        path.write_bytes(tiff(pixels, 16, photometric, channels, planes=planes))
        assert said in rejection(path).detail

    @pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
    def test_the_opacity_of_a_tiff_does_not_darken_it(
        self, tmp_path: Path, dtype: type[np.unsignedinteger[Any]]
    ) -> None:
        image = textured(dtype)
        pixels = np.dstack([image, image, image, textured(dtype)[::-1]])
        path = tmp_path / "frame.tif"
        bits = 8 * image.dtype.itemsize
        path.write_bytes(tiff(pixels.tobytes(), bits, 2, 4, opacity=2))
        np.testing.assert_allclose(read_grey(path, CAMERA), image, atol=1.0)

    @not_on_windows("does not hear what OpenCV says, see docs/design.md")
    @pytest.mark.parametrize("compression", ["tiff_lzw", "tiff_adobe_deflate", "jpeg"])
    @pytest.mark.parametrize("log_level", ["WARNING", "SILENT"])
    def test_a_damaged_strip_is_rejected_without_output_of_the_decoder(
        self,
        tmp_path: Path,
        capfd: pytest.CaptureFixture[str],
        compression: str,
        log_level: str,
    ) -> None:
        path = tmp_path / "frame.tif"
        Image.fromarray(textured() & 0xE0).save(path, compression=compression)
        data = path.read_bytes()
        middle = len(data) // 2
        path.write_bytes(data[:middle] + bytes(200) + data[middle + 200 :])
        set_log_level = cv2.utils.logging.setLogLevel
        before = set_log_level(getattr(cv2.utils.logging, f"LOG_LEVEL_{log_level}"))
        try:
            assert rejection(path).reason is Reason.DECODE_FAILED
        finally:
            set_log_level(before)
        assert capfd.readouterr() == ("", "")

    @pytest.mark.parametrize("shape", [(1, 1), (WIDTH, HEIGHT), (HEIGHT, WIDTH + 1)])
    def test_a_frame_of_another_size_is_rejected_with_both_sizes(
        self, tmp_path: Path, shape: tuple[int, int]
    ) -> None:
        path = tmp_path / "frame.png"
        path.write_bytes(encoded(np.zeros(shape, np.uint8), ".png"))
        caught = rejection(path)
        assert caught.reason is Reason.WRONG_SIZE
        assert caught.detail == f"{shape[1]} x {shape[0]} px, the camera has {WIDTH} x {HEIGHT}"


def test_frames_read_in_threads_have_their_own_damage_and_stderr_is_kept(tmp_path: Path) -> None:
    whole, damaged = tmp_path / "whole.jpg", tmp_path / "damaged.jpg"
    content = encoded(textured(), ".jpg")
    middle = len(content) // 2
    whole.write_bytes(content)
    damaged.write_bytes(content[:middle] + bytes(200) + content[middle + 200 :])
    stderr = os.fstat(2).st_ino

    def is_read(path: Path) -> bool:
        try:
            return read_grey(path, CAMERA).shape == (HEIGHT, WIDTH)
        except Rejection:
            return False

    with ThreadPoolExecutor(4) as pool:
        found = list(pool.map(is_read, [whole, damaged] * 200))
    assert found == [True, False] * 200
    assert os.fstat(2).st_ino == stderr


def test_programs_without_stderr_read_frames(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def no_descriptor(number: int) -> int:
        raise OSError(9, f"Bad file descriptor: {number}")

    path = tmp_path / "frame.png"
    path.write_bytes(encoded(textured(), ".png"))
    monkeypatch.setattr(sys, "stderr", None)
    monkeypatch.setattr(os, "dup", no_descriptor)
    np.testing.assert_array_equal(read_grey(path, CAMERA), textured())


@pytest.mark.skipif(sys.platform != "linux", reason="others have a temporary file")
def test_damage_is_noticed_without_a_temporary_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path / "gone"))
    path = tmp_path / "frame.tif"
    Image.fromarray(textured() & 0xE0).save(path, compression="tiff_lzw")
    data = path.read_bytes()
    assert read_grey(path, CAMERA).shape == (HEIGHT, WIDTH)
    middle = len(data) // 2
    path.write_bytes(data[:middle] + bytes(200) + data[middle + 200 :])
    assert rejection(path).reason is Reason.DECODE_FAILED


def test_a_lack_of_memory_is_no_damage(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "frame.png"
    path.write_bytes(encoded(textured(), ".png"))

    def full(*_: object) -> None:
        error = cv2.error("as OpenCV says it")
        error.code, error.err = cv2.Error.StsNoMem, "Failed to allocate 48000000 bytes"
        raise error

    monkeypatch.setattr(cv2, "imdecode", full)
    with pytest.raises(MemoryError, match="Failed to allocate 48000000 bytes"):
        read_grey(path, CAMERA)
