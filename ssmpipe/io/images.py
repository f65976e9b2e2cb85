"""Photographs and masks in, guarded: a bad file ends in one line that says what is wrong with it."""

from __future__ import annotations

import warnings
from pathlib import Path
from typing import Any

import numpy as np

from ssmpipe.core.errors import ArtifactError, GeometryError
from ssmpipe.core.outline.picture import Picture

_FORMATS = {
    ".png": "PNG", ".jpg": "JPEG", ".jpeg": "JPEG", ".bmp": "BMP", ".tif": "TIFF", ".tiff": "TIFF", ".pgm": "PPM",
    ".ppm": "PPM", ".pbm": "PPM", ".pnm": "PPM", ".webp": "WEBP",
}  # fmt: skip

IMAGE_SUFFIXES = tuple(_FORMATS)
"""Suffixes that :func:`read_image` accepts, in lower case."""

MAX_BYTES = 512 * 2**20
MAX_PIXELS = 100_000_000
MAX_RATIO = 500
"""Largest number of pixels per byte of a file that has more than 20 million of them; masks reach some hundreds."""

_MANY_PIXELS = 20_000_000
_TOO_MANY = f"at most {MAX_PIXELS // 10**6} million are read"
_AGAIN = "open it in an image viewer and save it again as PNG"
_TURNS = {2: "mirrored", 3: "turned by 180 degrees", 4: "mirrored and turned by 180 degrees", 5: "mirrored and turned",
          6: "turned by 90 degrees", 7: "mirrored and turned", 8: "turned by 270 degrees"}  # fmt: skip
_ORIENTATION = 0x0112


def read_image(path: Path, remarks: list[str] | None = None) -> Picture:
    """Read a photograph or a mask.

    Palettes become colours, 16-bit grey keeps its steps, CMYK becomes red, green and blue. Pixels that are less than half
    opaque count as transparent. A photograph that says how it must be turned (EXIF) is turned, as viewers do.

    Parameters
    ----------
    path : Path
        ``.png .jpg .jpeg .bmp .tif .tiff .pgm .ppm .pbm .pnm .webp``, in either case; the first picture of the file.
    remarks : list of str, optional
        Gets what the user should know of a file that can be read all the same.

    Returns
    -------
    Picture

    Raises
    ------
    ArtifactError
        With one line: unknown suffix, empty, truncated, another format than the suffix says, more than 100 million pixels,
        several pages.
    """
    path = Path(path)
    image, turned = _opened(path, load=True)
    try:
        if turned and remarks is not None:
            remarks.append(
                f"the camera says that the picture must be {turned}, and it was; landmarks must belong to the turned picture"
            )
        return _picture(image)
    except (GeometryError, ArtifactError) as error:
        raise ArtifactError(error.fact, error.remedy or _AGAIN) from error


def image_size(path: Path) -> tuple[int, int]:
    """Return width and height [pixels] from the header, as a viewer shows the image.

    Raises
    ------
    ArtifactError
        As :func:`read_image`.
    """
    image, _ = _opened(Path(path), load=False)
    width, height = image.size
    return (height, width) if _orientation(image) >= 5 else (width, height)


def _opened(path: Path, *, load: bool) -> tuple[Any, str]:
    from PIL import Image, ImageOps  # only where there are images

    suffix = path.suffix.lower()
    if suffix not in _FORMATS:
        raise ArtifactError(
            f"'{path.suffix}' is not an image format that can be read ({' '.join(IMAGE_SUFFIXES)})",
            "convert it to .png",
        )
    formats = [_FORMATS[suffix], "MPO"] if suffix in (".jpg", ".jpeg") else [_FORMATS[suffix]]
    _check_file(path)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of doubtful metadata and of size, which is checked below
            with Image.open(path, formats=formats) as image:
                width, height = image.size
                if width * height > MAX_PIXELS:
                    raise ArtifactError(
                        f"the image has {width} x {height} pixels, {_TOO_MANY}",
                        "make it smaller first",
                    )
                if width * height > max(_MANY_PIXELS, MAX_RATIO * path.stat().st_size):
                    raise ArtifactError(
                        f"the image has {width} x {height} pixels in {path.stat().st_size} bytes, which no photograph has",
                        "make it smaller first",
                    )
                n_pages = getattr(image, "n_frames", 1) if image.format != "MPO" else 1
                if n_pages > 1:
                    raise ArtifactError(f"the file has {n_pages} pages or frames", "save the one that shows the shape")
                if not load:
                    return image, ""
                image.load()
                turned = _TURNS.get(_orientation(image), "")
                return (ImageOps.exif_transpose(image) if turned else image.copy()), turned
    except ArtifactError:
        raise
    except Image.DecompressionBombError as error:
        text = " ".join(str(error).split())[:60]
        raise ArtifactError(f"the image is too large ({text}), {_TOO_MANY}", "make it smaller first") from error
    except (Exception, SystemExit) as error:
        text = " ".join(str(error).split())[:120].replace(str(path), path.name)
        raise ArtifactError(f"not a readable {formats[0]} file ({type(error).__name__}: {text})", _AGAIN) from error


def _orientation(image: Any) -> int:
    try:
        return int(image.getexif().get(_ORIENTATION, 1))
    except (Exception, SystemExit):  # metadata that nobody can read does not make the pixels worse
        return 1


def _check_file(path: Path) -> None:
    try:
        if not path.is_file():
            raise ArtifactError(
                "there is no such file" if not path.exists() else "this is not a file", "check the path"
            )
        size = path.stat().st_size
        with path.open("rb") as file:
            head = file.read(200).lstrip().lower()
    except OSError as error:
        raise ArtifactError(f"the file cannot be read ({error.strerror or error})", "check its permissions") from error
    if size == 0:
        raise ArtifactError("the file is empty", _AGAIN)
    if size > MAX_BYTES:
        raise ArtifactError(f"the file has {size} bytes, at most {MAX_BYTES} are read", "make the image smaller first")
    if head.startswith((b"<!doctype html", b"<html")):
        raise ArtifactError("this is a web page, not an image", "download the file again, logged in if needed")
    if head.startswith(b"version https://git-lfs"):
        raise ArtifactError("this is a Git LFS pointer, not the image itself", "run 'git lfs pull'")


def _picture(image: Any) -> Picture:
    """Turn any mode of Pillow into grey or colour values from 0 to 1."""
    opaque = None
    if image.mode in ("LA", "La", "PA", "RGBA", "RGBa") or "transparency" in image.info:
        alpha = np.asarray(image.convert("RGBA").getchannel("A"))
        opaque = alpha >= 128 if (alpha < 128).any() else None
        image = image.convert("L" if image.mode in ("LA", "La", "L", "1") else "RGB")
    if image.mode.startswith("I;16"):
        return Picture(np.asarray(image).astype(np.float32)[..., None] / 65535.0, opaque)
    if image.mode in ("I", "F"):
        values = np.asarray(image).astype(np.float64)
        if not np.isfinite(values).all():
            raise ArtifactError("the image has values that are not finite", _AGAIN)
        low, high = float(values.min()), float(values.max())
        return Picture(((values - low) / max(high - low, 1e-300))[..., None], opaque)
    if image.mode in ("1", "L"):
        return Picture(np.asarray(image.convert("L"), dtype=np.float32)[..., None] / 255.0, opaque)
    return Picture(np.asarray(image.convert("RGB"), dtype=np.float32) / 255.0, opaque)
