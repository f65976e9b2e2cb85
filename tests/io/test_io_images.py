"""Photographs and masks: every mode, odd but valid files, and files that must be refused in one line."""

from __future__ import annotations

import contextlib
import io
import struct
import zlib
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from ssmpipe.core.errors import ArtifactError
from ssmpipe.io.images import IMAGE_SUFFIXES, MAX_PIXELS, image_size, read_image
from ssmpipe.runner import sources

COLORS = np.random.default_rng(0).integers(0, 256, size=(12, 20, 3), dtype=np.uint8)


def png(width: int, height: int, data: bytes = b"") -> bytes:
    """A PNG with any size in its header."""

    def chunk(kind: bytes, body: bytes) -> bytes:
        return struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))

    header = struct.pack(">IIBBBBB", width, height, 8, 0, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", data) + chunk(b"IEND", b"")


def test_the_runner_knows_the_same_suffixes() -> None:
    assert sources.IMAGE_SUFFIXES == IMAGE_SUFFIXES


@pytest.mark.parametrize("name", ["a.png", "a.BMP", "a.tif", "a.ppm", "a.webp"])
def test_lossless_colours_come_back(tmp_path: Path, name: str) -> None:
    Image.fromarray(COLORS).save(tmp_path / name, **({"lossless": True} if name.endswith("webp") else {}))
    picture = read_image(tmp_path / name)
    np.testing.assert_allclose(picture.colors, COLORS / 255, atol=1e-6)
    assert picture.opaque is None
    assert image_size(tmp_path / name) == (20, 12)


def test_modes(tmp_path: Path) -> None:
    gray = COLORS[..., 0]
    for mode, suffix in (("L", "png"), ("1", "pbm"), ("P", "png"), ("CMYK", "jpg"), ("LA", "png"), ("RGBA", "png")):
        path = tmp_path / f"{mode}.{suffix}"
        Image.fromarray(COLORS).convert(mode).save(path)
        picture = read_image(path)
        assert picture.size == (12, 20)
        assert picture.colors.shape[2] == (1 if mode in ("L", "1", "LA") else 3)
        assert 0 <= picture.colors.min() <= picture.colors.max() <= 1
        assert picture.opaque is None, "opaque all over says nothing"
    deep = gray.astype(np.uint16) * 200
    Image.fromarray(deep).save(tmp_path / "deep.png")
    np.testing.assert_allclose(read_image(tmp_path / "deep.png").colors[..., 0], deep / 65535, atol=1e-6)
    Image.fromarray(gray.astype(np.float32) - 40).save(tmp_path / "float.tif")
    values = read_image(tmp_path / "float.tif").colors
    assert (values.min(), values.max()) == (0, 1)


def test_transparent_pixels_are_told(tmp_path: Path) -> None:
    alpha = np.where(np.arange(20) < 7, 0, 255).astype(np.uint8) * np.ones((12, 1), np.uint8)
    Image.fromarray(np.dstack([COLORS, alpha])).save(tmp_path / "a.png")
    picture = read_image(tmp_path / "a.png")
    assert picture.opaque is not None
    assert np.array_equal(picture.opaque, alpha == 255)


def test_a_turned_photograph_is_turned_and_says_so(tmp_path: Path) -> None:
    exif = Image.Exif()
    exif[0x0112] = 6
    Image.fromarray(COLORS).save(tmp_path / "a.png", exif=exif)
    remarks: list[str] = []
    picture = read_image(tmp_path / "a.png", remarks)
    assert "turned by 90 degrees" in remarks[0]
    assert picture.size == (20, 12)
    np.testing.assert_allclose(picture.colors, np.rot90(COLORS, -1) / 255, atol=1e-6)
    assert image_size(tmp_path / "a.png") == (12, 20)


def test_hostile_files_end_in_one_line(tmp_path: Path) -> None:
    whole = io.BytesIO()
    Image.fromarray(COLORS).save(whole, format="PNG")
    pages = io.BytesIO()
    Image.fromarray(COLORS).save(pages, format="TIFF", save_all=True, append_images=[Image.fromarray(COLORS)])
    files = {
        "empty.png": (b"", "is empty"),
        "text.png": (b"hello", "not a readable PNG"),
        "page.jpg": (b"<!DOCTYPE html><html>", "web page"),
        "lfs.jpg": (b"version https://git-lfs.github.com/spec/v1", "Git LFS pointer"),
        "cut.png": (whole.getvalue()[:200], "not a readable PNG"),
        "jpeg_in_name.jpg": (whole.getvalue(), "not a readable JPEG"),
        "bomb.png": (png(60000, 60000), "3600000000 pixels"),
        "large.png": (png(12000, 10000), "12000 x 10000 pixels, at most 100 million"),
        "huge.png": (png(2**31 - 1, 2**31 - 1), "pixels|not a readable"),
        "hollow.png": (png(50, 50), "not a readable PNG"),
        "lies.pgm": (b"P5 400 400 255\n\x00\x00", "not a readable PPM"),
        "boasts.pgm": (b"P5 5000 5000 255\n\x00\x00", "5000 x 5000 pixels in 19 bytes"),
        "pages.tif": (pages.getvalue(), "2 pages"),
        "a.gif": (b"GIF89a", "not an image format"),
        "nan.tif": (b"", ""),
    }
    for name, (data, message) in files.items():
        if not message:
            continue
        (tmp_path / name).write_bytes(data)
        with pytest.raises(ArtifactError, match=message) as caught:
            read_image(tmp_path / name)
        assert "\n" not in str(caught.value)
        assert caught.value.remedy
    values = np.zeros((20, 20), np.float32)
    values[3, 3] = np.nan
    Image.fromarray(values).save(tmp_path / "nan.tif")
    with pytest.raises(ArtifactError, match="not finite"):
        read_image(tmp_path / "nan.tif")
    with pytest.raises(ArtifactError, match="no such file"):
        read_image(tmp_path / "none.png")
    (tmp_path / "folder.png").mkdir()
    with pytest.raises(ArtifactError, match="not a file"):
        read_image(tmp_path / "folder.png")
    assert MAX_PIXELS == 100_000_000


def test_any_damaged_byte_is_read_or_refused(tmp_path: Path) -> None:
    rng = np.random.default_rng(1)
    for suffix, kind in ((".png", "PNG"), (".jpg", "JPEG"), (".tif", "TIFF"), (".bmp", "BMP"), (".webp", "WEBP")):
        whole = io.BytesIO()
        Image.fromarray(COLORS).save(whole, format=kind)
        for _ in range(12):
            data = bytearray(whole.getvalue())
            for at in rng.integers(len(data), size=3):
                data[at] = rng.integers(256)
            path = tmp_path / f"a{suffix}"
            path.write_bytes(bytes(data))
            with contextlib.suppress(ArtifactError):  # anything else would fail the test
                read_image(path)
