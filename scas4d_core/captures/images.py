"""Decodes and resizes images and masks. Requires only NumPy and Pillow.

Image files are handled as follows:

======================  ====================================================================================
EXIF orientation ≠ 1    rejected: intrinsics are valid for one orientation of the pixels only, and the file
                        does not record for which orientation the camera was calibrated
alpha (also palette)    composited over black, the empty background of a capture, without linearization
grey                    replicated to three channels
16 bit                  grey: value / 257, rounded to 8 bit; colour: the high byte (at most one level off)
ICC profile             converted to sRGB (relative colorimetric), unless its description names sRGB
grey ICC profile        ignored
no ICC profile          assumed to be sRGB; gAMA and cHRM chunks are ignored
CMYK, float, Lab        rejected
more than one image     rejected (animations, multi-page and multi-image files)
======================  ====================================================================================

A mask is 1 where the stored value of any channel is nonzero. Masks with alpha or in lossy formats are rejected.
"""

from __future__ import annotations

import io
from collections import Counter
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageCms

from scas4d_core.frame_outcome import grey_warnings

PICTURE_FORMATS = ("PNG", "JPEG", "WEBP", "BMP", "PPM")
MASK_FORMATS = ("PNG", "BMP")
EXIF_ORIENTATION = 0x0112
SIZES = 5
"""Number of images to compare if the first one does not have the calibrated size."""

Size = tuple[int, int]


class ImageError(ValueError):
    """Raised if an image or mask cannot be used; the message names the file and the problem."""


def scaled_size(size: Size, image_scale: float) -> Size:
    """Returns width and height multiplied by ``image_scale``, rounded as in `Camera.scaled`."""
    if not (np.isfinite(image_scale) and image_scale > 0):
        raise ImageError(f"image_scale must be a positive number; got {image_scale!r}")
    return max(1, round(size[0] * image_scale)), max(1, round(size[1] * image_scale))


def decode_image(
    source: bytes | Path, *, size: Size | None = None, image_scale: float = 1.0, name: str | None = None
) -> NDArray[np.uint8]:
    """Decodes an image file to 8-bit sRGB values.

    Args:
        source: image file, as bytes or as a path.
        size: required (width, height) of the file in pixels, before scaling; not checked if None.
        image_scale: scale factor. The image is resized by area averaging to the size that
            `Camera.scaled` returns.
        name: name of the image in error messages; defaults to the path.

    Returns:
        Image [H, W, 3] uint8.

    Raises:
        ImageError: if the file is missing, is not an image, has the wrong size, or has properties
            that the docstring of this module lists as rejected.

    >>> file = io.BytesIO()
    >>> Image.new("RGB", (4, 2), (255, 128, 0)).save(file, "PNG")
    >>> decode_image(file.getvalue(), size=(4, 2)).shape
    (2, 4, 3)
    >>> decode_image(file.getvalue(), image_scale=0.5)
    array([[[255, 128,   0],
            [255, 128,   0]]], dtype=uint8)
    """
    name = name or _name(source)
    picture = _open(source, name, PICTURE_FORMATS, size)
    rgb = _rgb(picture, name)
    return resize_area(rgb, scaled_size(picture.size, image_scale))


def decode_mask(
    source: bytes | Path, *, size: Size | None = None, image_scale: float = 1.0, name: str | None = None
) -> NDArray[np.uint8]:
    """Decodes a foreground mask. The arguments and errors are those of `decode_image`.

    A pixel is foreground if the stored value of any channel is nonzero. A pixel of a scaled mask is
    foreground if at least half of its area is foreground.

    Returns:
        Mask [H, W] uint8, 1 on the foreground and 0 elsewhere.

    >>> file = io.BytesIO()
    >>> Image.fromarray(np.array([[0, 1, 255]], np.uint8)).save(file, "PNG")
    >>> decode_mask(file.getvalue())
    array([[0, 1, 1]], dtype=uint8)
    """
    name = name or _name(source)
    picture = _open(source, name, MASK_FORMATS, size)
    if picture.mode in ("LA", "PA", "RGBA", "La", "RGBa"):
        raise ImageError(
            f"{name}: a mask with an alpha channel is ambiguous; use a single channel, with 0 for background"
        )
    values = np.asarray(picture)  # palette images give the index, not the colour
    foreground = values != 0
    if foreground.ndim == 3:
        foreground = foreground.any(axis=-1)
    return resize_mask(np.array(foreground, dtype=np.uint8), scaled_size(picture.size, image_scale))


def decode_labels(source: bytes | Path, *, size: Size, target: Size, name: str | None = None) -> NDArray[np.uint8]:
    """Decodes an 8-bit single-channel label image, and resizes it by sampling.

    Args:
        source: image file, as bytes or as a path.
        size: required (width, height) of the file in pixels.
        target: (width, height) of the result; each pixel takes the label at its centre.
        name: name of the image in error messages; defaults to the path.

    Returns:
        Labels [H, W] uint8.

    Raises:
        ImageError: if the file is missing or invalid, has the wrong size, or has more than one channel.

    >>> file = io.BytesIO()
    >>> Image.fromarray(np.array([[3, 3, 7, 7]], np.uint8)).save(file, "PNG")
    >>> decode_labels(file.getvalue(), size=(4, 1), target=(2, 1))
    array([[3, 7]], dtype=uint8)
    """
    name = name or _name(source)
    picture = _open(source, name, MASK_FORMATS, size)
    if picture.mode not in ("L", "P"):
        raise ImageError(f"{name}: labels must have a single 8-bit channel; got colour mode {picture.mode}")
    columns, rows = (
        np.floor((np.arange(count) + 0.5) * (length / count)).astype(np.intp)
        for count, length in zip(target, size, strict=True)
    )
    labels: NDArray[np.uint8] = np.asarray(picture)[np.ix_(rows, columns)]
    return labels


def picture_size(source: bytes | Path, name: str | None = None) -> Size:
    """Returns the width and height of an image in pixels. The pixels are not decoded.

    >>> file = io.BytesIO()
    >>> Image.new("RGB", (4, 2)).save(file, "JPEG")
    >>> picture_size(file.getvalue())
    (4, 2)
    """
    name = name or _name(source)
    try:
        with Image.open(_stream(source), formats=PICTURE_FORMATS) as picture:
            return picture.size
    except Exception as fault:
        raise _unreadable(name, fault) from fault


def usual_size(paths: Iterable[Path], calibrated: Size | None = None) -> tuple[Path, Size]:
    """Returns the first image of a camera that has the camera's usual size, and this size.

    The usual size is the calibrated size if one of the first images has it, or else the most common size among them.
    Images that cannot be read are ignored. The pixels are not decoded.

    Args:
        paths: images of a camera.
        calibrated: (width, height) for which the camera was calibrated, or None if unknown.

    Raises:
        ImageError: if no image can be read.
    """
    sizes: dict[Path, Size] = {}
    fault = ImageError("there is no image")
    for number, path in enumerate(paths):
        try:
            size = picture_size(path)
        except ImageError as error:
            fault = error if number == 0 else fault
            continue
        if size == calibrated:
            return path, size
        sizes[path] = size
        if len(sizes) == SIZES:
            break
    if not sizes:
        raise fault
    common = Counter(sizes.values()).most_common(1)[0][0]
    return next(path for path, size in sizes.items() if size == common), common


def resize_area(picture: NDArray[np.uint8], size: Size) -> NDArray[np.uint8]:
    """Resizes an image [H, W, C] to (width, height) by area averaging.

    The edges of the image stay aligned. Pixel coordinates, with pixel centres at +0.5, therefore
    scale by the ratio of the sizes, as in `Camera.scaled`. Pillow's BOX filter is unsuitable: it
    weights whole source pixels only, and is half a pixel off at fractional ratios.

    >>> resize_area(np.array([[[0], [10], [20]]], np.uint8), size=(2, 1))[..., 0]
    array([[ 3, 17]], dtype=uint8)
    """
    if size == (picture.shape[1], picture.shape[0]):
        return picture
    return np.rint(area_average(picture.astype(np.float64), size)).astype(np.uint8)


def resize_mask(mask: NDArray[np.uint8], size: Size) -> NDArray[np.uint8]:
    """Resizes a mask [H, W] of 0 and 1 to (width, height).

    A pixel of the result is 1 if at least half of its area is 1 in the original mask.

    >>> resize_mask(np.array([[1, 1, 1, 0]], np.uint8), size=(2, 1))
    array([[1, 1]], dtype=uint8)
    """
    if size == (mask.shape[1], mask.shape[0]):
        return mask
    resized: NDArray[np.uint8] = (area_average(mask.astype(np.float64), size) >= 0.5 - 1e-9).astype(np.uint8)
    return resized


def eight_bit_file(data: bytes, size: Size, name: str = "picture") -> bytes:
    """Returns an 8-bit JPEG, PNG or WebP file unchanged, and any other image as an 8-bit PNG file.

    Raises:
        ImageError: if the image cannot be decoded, or does not have the given (width, height).

    >>> file = io.BytesIO()
    >>> Image.fromarray(np.full((2, 4), 25700, np.uint16)).save(file, "PNG")
    >>> decode_image(eight_bit_file(file.getvalue(), size=(4, 2)))[0, 0].tolist()
    [100, 100, 100]
    """
    picture = decode_image(data, size=size, name=name)  # truncated files are found only by decoding them
    sent = data.startswith((b"\xff\xd8", b"\x89PNG")) or data[8:12] == b"WEBP"
    if sent and not is_sixteen_bit(data):
        return data
    file = io.BytesIO()
    Image.fromarray(picture).save(file, "PNG", compress_level=1)
    return file.getvalue()


def is_sixteen_bit(head: bytes) -> bool:
    """Returns whether a file is a PNG with 16 bits per channel, given its first 25 bytes."""
    return head.startswith(b"\x89PNG") and head[24:25] == b"\x10"


def describe_pictures(files: Mapping[str, Path]) -> list[str]:
    """Returns remarks for the user on 16-bit images, and on greyscale cameras in a colour rig.

    The remarks are based on the headers of the files. The pixels are not decoded.

    Args:
        files: maps each camera name to one of its image files.

    Raises:
        ImageError: if an image cannot be read.
    """
    remarks, grey = [], {}
    for camera, path in files.items():
        try:
            with path.open("rb") as file:
                deep = is_sixteen_bit(file.read(25))
            with Image.open(path, formats=PICTURE_FORMATS) as picture:
                grey[camera] = picture.mode in ("1", "L", "LA", "I;16", "I;16B", "I;16L", "I")
        except Exception as fault:
            raise _unreadable(str(path), fault) from fault
        if deep:
            grey_or_colour = "rounded (value / 257)" if grey[camera] else "reduced to their high byte"
            remarks.append(f"camera {camera!r}: 16-bit images are converted to 8 bits, {grey_or_colour}")
    return remarks + mixed_colours(grey)


def mixed_colours(grey: Mapping[str, bool]) -> list[str]:
    """Returns a remark for the user if only some of the cameras are greyscale.

    Args:
        grey: maps each camera name to whether its images are greyscale.

    Returns:
        A list with one remark, or an empty list if all cameras are of the same kind.
    """
    if len(set(grey.values())) < 2:
        return []
    return grey_warnings([name for name, is_grey in grey.items() if is_grey])


def grey_among(images: Mapping[str, NDArray[np.uint8]]) -> list[str]:
    """Returns the names of the greyscale cameras in a rig that also has colour cameras.

    An image of a colour camera has at least one pixel that is not grey, because of sensor noise. An
    image in which all values are equal does not show whether its camera is greyscale.

    Args:
        images: maps each camera name to its image [H, W, 3].

    >>> grey = np.arange(12, dtype=np.uint8).reshape(2, 2, 3)[..., :1].repeat(3, axis=2)
    >>> red = grey + np.uint8([1, 0, 0])
    >>> grey_among({"a": red, "b": grey}), grey_among({"b": grey}), grey_among({"a": red, "dark": 0 * grey})
    (['b'], [], [])
    """
    colour = {name: bool((image != image[..., :1]).any()) for name, image in images.items() if image.ndim == 3}
    if not any(colour.values()):
        return []
    return [name for name, coloured in colour.items() if not coloured and images[name].min() < images[name].max()]


def area_average(picture: NDArray[np.float64], size: Size) -> NDArray[np.float64]:
    """Resizes float64 images [H, W] or [H, W, C] like ``resize_area``, without rounding."""
    for axis, target in ((0, size[1]), (1, size[0])):
        picture = np.moveaxis(picture, axis, 0)
        length = picture.shape[0]
        # The cumulative integral of the image is linear within a pixel. Linear interpolation at the
        # new edges is therefore exact.
        integral = np.concatenate([np.zeros_like(picture[:1]), np.cumsum(picture, axis=0)])
        edges = np.arange(target + 1) * (length / target)
        left = np.minimum(edges.astype(np.intp), length - 1)
        inside = (edges - left).reshape(-1, *[1] * (picture.ndim - 1))
        at_edges = integral[left] + inside * picture[left]
        picture = np.moveaxis(np.diff(at_edges, axis=0) * (target / length), 0, axis)
    return picture


def _name(source: bytes | Path) -> str:
    return "image data" if isinstance(source, bytes) else str(source)


def _stream(source: bytes | Path) -> io.BytesIO:
    return io.BytesIO(source if isinstance(source, bytes) else source.read_bytes())


def _unreadable(name: str, fault: Exception) -> ImageError:
    if isinstance(fault, ImageError):
        return fault
    if isinstance(fault, FileNotFoundError):
        return ImageError(f"{name}: no such file")
    return ImageError(f"{name} cannot be read as an image ({type(fault).__name__}: {fault})")


def _open(source: bytes | Path, name: str, formats: tuple[str, ...], size: Size | None) -> Image.Image:
    # Pillow raises many types of exceptions for damaged files (OSError, SyntaxError, …).
    try:
        picture = Image.open(_stream(source), formats=formats)
        # The size is checked before decoding, because a small file can decompress to gigabytes.
        if size is not None and picture.size != size:
            raise ImageError(
                f"{name} is {picture.width}x{picture.height} pixels, but its camera requires {size[0]}x{size[1]}; "
                "use images of the size for which the camera was calibrated (image_scale resizes both)"
            )
        count = getattr(picture, "n_frames", 1)
        if count > 1:
            raise ImageError(f"{name} contains {count} images; use a file with a single image")
        orientation = picture.getexif().get(EXIF_ORIENTATION, 1)
        if orientation != 1:
            raise ImageError(
                f"{name}: EXIF orientation is {orientation}; the intrinsics apply to the stored pixels and would not "
                "match a rotated image; store the pixels in the calibrated orientation and remove the tag"
            )
        picture.load()
    except Exception as fault:
        raise _unreadable(name, fault) from fault
    return picture


def _rgb(picture: Image.Image, name: str) -> NDArray[np.uint8]:
    profile = picture.info.get("icc_profile")
    if picture.mode in ("I;16", "I;16B", "I;16L", "I"):
        grey = np.asarray(picture).astype(np.int64)
        if grey.min() < 0 or grey.max() > 65535:
            raise ImageError(
                f"{name}: grey values {grey.min()}…{grey.max()} exceed 16 bits; use 8-bit or 16-bit values"
            )
        picture = Image.fromarray(((grey + 128) // 257).astype(np.uint8))
    if picture.mode not in ("1", "L", "LA", "P", "PA", "RGB", "RGBA"):
        raise ImageError(f"{name}: colour mode {picture.mode} is not supported; use RGB or grayscale")
    transparent = picture.mode in ("LA", "PA", "RGBA") or "transparency" in picture.info
    picture = picture.convert("RGBA" if transparent else "RGB")
    alpha = np.asarray(picture.getchannel("A")).astype(np.uint32)[..., None] if transparent else None
    picture = picture.convert("RGB")
    if profile:
        picture = _to_srgb(picture, profile, name)
    rgb: NDArray[np.uint8] = np.array(picture)
    if alpha is not None:
        rgb = ((rgb * alpha + 127) // 255).astype(np.uint8)
    return rgb


def _to_srgb(picture: Image.Image, profile: bytes, name: str) -> Image.Image:
    try:
        source: Any = ImageCms.ImageCmsProfile(io.BytesIO(profile))
        described = source.profile.profile_description or ""
        if source.profile.xcolor_space.strip() != "RGB" or "sRGB" in described:
            # A grey profile is only a tone curve. A conversion from sRGB to sRGB would only add
            # rounding errors.
            return picture
        converted = ImageCms.profileToProfile(
            picture, source, ImageCms.createProfile("sRGB"), ImageCms.Intent.RELATIVE_COLORIMETRIC
        )
    except (ImageCms.PyCMSError, OSError) as fault:
        raise ImageError(f"{name}: the ICC profile cannot be read ({fault}); convert the image to sRGB") from fault
    assert converted is not None  # only in-place conversion returns None
    return converted
