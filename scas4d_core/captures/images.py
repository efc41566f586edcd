"""Decides which files are images and masks, and decodes and resizes them. Requires only NumPy, Pillow and simplejpeg.

The service, the worker and the importers all use these rules:

======================  ====================================================================================
formats                 JPEG, PNG, WebP, BMP, and binary PPM and PGM; of masks, PNG and BMP
more than one image     the first image is used (MPO, animated PNG and WebP)
EXIF orientation 2…8    rejected in all formats: intrinsics are valid for one orientation of the pixels only, and
                        the file does not record for which orientation the camera was calibrated
alpha (also palette)    composited over black, the empty background of a capture, without linearization
grey                    replicated to three channels
16 bit                  scaled to 8 bit from a given bit depth, and rounded; rejected if the depth is not given
ICC profile             converted to sRGB (relative colorimetric), unless its description names sRGB; rejected if
                        it is damaged
grey ICC profile        ignored
no ICC profile          assumed to be sRGB; gAMA and cHRM chunks are ignored
CMYK, float, Lab        rejected
truncated or damaged    rejected, except damage within the scan of a JPEG, which its format cannot detect
======================  ====================================================================================

A mask is 1 where the stored value of any channel is nonzero. Masks with alpha or in lossy formats are rejected.
"""

from __future__ import annotations

import io
import math
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from functools import cached_property, lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageCms, UnidentifiedImageError
from simplejpeg import decode_jpeg

from scas4d_core.captures.bit_depth import find_bit_depth, is_sixteen_bit, sixteen_bit_values, to_eight_bits
from scas4d_core.captures.picture_file import ACCEPTED, RESEND, ImageError, PictureHeader, picture_header
from scas4d_core.frame_outcome import grey_warnings

FORMATS = ("JPEG", "PNG", "WEBP", "BMP", "PPM")
MASK_FORMATS = ("PNG", "BMP")
EXIF_ORIENTATION = 0x0112
SAMPLED_FRAMES = 8
"""Number of frames, evenly spaced over the capture, whose values determine the bit depth."""
SIZES = 5
"""Number of images to compare if the first one does not have the calibrated size."""

Size = tuple[int, int]
Source = bytes | memoryview | Path


def scaled_size(size: Size, image_scale: float) -> Size:
    """Returns width and height multiplied by ``image_scale``, rounded as in `Camera.scaled`."""
    if not (np.isfinite(image_scale) and image_scale > 0):
        raise ImageError(f"image_scale must be a positive number; got {image_scale!r}")
    return max(1, round(size[0] * image_scale)), max(1, round(size[1] * image_scale))


def decode_image(
    source: Source,
    *,
    size: Size | None = None,
    bit_depth: int | None = None,
    name: str | None = None,
) -> NDArray[np.uint8]:
    """Decodes an image file to 8-bit sRGB values.

    Args:
        source: image file, as bytes or as a path.
        size: required (width, height) of the file in pixels; not checked if None.
        bit_depth: number of bits that the values of a 16-bit file use (see `find_bit_depth`). If None,
            16-bit files are rejected.
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
    """
    return _PictureFile(source, name or _name(source), size).rgb(bit_depth)


def check_image(source: Source, *, size: Size | None = None, name: str | None = None) -> None:
    """Raises the error that `decode_image` would raise for a file.

    The pixels of common JPEG files and of raw pixels are not decoded, because their structure shows that they can be.
    Of those without metadata, only the structure is checked.

    Args:
        source: image file, as bytes or as a path.
        size: required (width, height) of the file in pixels; not checked if None.
        name: name of the image in error messages; defaults to the path.

    Raises:
        ImageError: if the file cannot be used as an image.

    >>> check_image(b"GIF89a", name="north")
    Traceback (most recent call last):
    ...
    scas4d_core.captures.picture_file.ImageError: north: not a JPEG, PNG, WebP, BMP, PPM or PGM file: ...
    """
    picture = _PictureFile(source, name or _name(source), size)
    if not picture.is_plain:
        picture.rgb(bit_depth=None)


def decode_mask(source: Source, *, size: Size | None = None, name: str | None = None) -> NDArray[np.uint8]:
    """Decodes a foreground mask. The arguments and errors are those of `decode_image`.

    A pixel is foreground if the stored value of any channel is nonzero.

    Returns:
        Mask [H, W] uint8, 1 on the foreground and 0 elsewhere.

    >>> file = io.BytesIO()
    >>> Image.fromarray(np.array([[0, 1, 255]], np.uint8)).save(file, "PNG")
    >>> decode_mask(file.getvalue())
    array([[0, 1, 1]], dtype=uint8)
    """
    values = _PictureFile(source, name or _name(source), size, mask=True).stored()
    foreground = values != 0
    if foreground.ndim == 3:
        foreground = foreground.any(axis=-1)
    return np.array(foreground, dtype=np.uint8)


def check_mask(source: Source, *, size: Size | None = None, name: str | None = None) -> None:
    """Raises the error that `decode_mask` would raise for a file. The arguments are those of `check_image`.

    >>> file = io.BytesIO()
    >>> Image.new("L", (4, 2)).save(file, "JPEG")
    >>> check_mask(file.getvalue(), name="mask.north")
    Traceback (most recent call last):
    ...
    scas4d_core.captures.picture_file.ImageError: mask.north: masks must be PNG or BMP, not JPEG; ...
    """
    _PictureFile(source, name or _name(source), size, mask=True).stored()


def decode_labels(source: bytes | Path, *, size: Size, target: Size) -> NDArray[np.uint8]:
    """Decodes an 8-bit single-channel label image, and resizes it by sampling.

    Args:
        source: image file, as bytes or as a path.
        size: required (width, height) of the file in pixels.
        target: (width, height) of the result; each pixel takes the label at its centre.

    Returns:
        Labels [H, W] uint8.

    Raises:
        ImageError: if the file is missing or invalid, has the wrong size, or has more than one channel.

    >>> file = io.BytesIO()
    >>> Image.fromarray(np.array([[3, 3, 7, 7]], np.uint8)).save(file, "PNG")
    >>> decode_labels(file.getvalue(), size=(4, 1), target=(2, 1))
    array([[3, 7]], dtype=uint8)
    """
    name = _name(source)
    stored = _PictureFile(source, name, size, mask=True).stored()
    if stored.ndim != 2 or stored.dtype != np.uint8:
        raise ImageError(f"{name}: labels must have a single 8-bit channel; got {stored.dtype} [{stored.shape}]")
    columns, rows = (
        np.floor((np.arange(count) + 0.5) * (length / count)).astype(np.intp)
        for count, length in zip(target, size, strict=True)
    )
    labels: NDArray[np.uint8] = stored[np.ix_(rows, columns)]
    return labels


def picture_size(path: Path) -> Size:
    """Returns the width and height of an image file in pixels. The pixels are not decoded.

    Raises:
        ImageError: if the file is missing or its header cannot be read.

    >>> picture_size(Path("samples/robot/ims/3/000000.png"))
    (256, 256)
    """
    with _errors_of(str(path)), _open(path) as picture:
        return picture.size


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


def eight_bit_file(data: bytes, size: Size | None = None, name: str = "picture", bit_depth: int | None = None) -> bytes:
    """Returns an 8-bit JPEG, PNG or WebP file unchanged, and any other image as an 8-bit PNG file.

    Args:
        data: contents of the file.
        size: required (width, height); not checked if None.
        name: name of the image in error messages.
        bit_depth: see `decode_image`.

    Raises:
        ImageError: if the image cannot be decoded, or has another size.

    >>> file = io.BytesIO()
    >>> Image.fromarray(np.full((2, 4), 25700, np.uint16)).save(file, "PNG")
    >>> decode_image(eight_bit_file(file.getvalue(), bit_depth=16))[0, 0].tolist()
    [100, 100, 100]
    """
    sent = data.startswith((b"\xff\xd8", b"\x89PNG")) or data[8:12] == b"WEBP"
    if sent and not is_sixteen_bit(data):
        check_image(data, size=size, name=name)
        return data
    file = io.BytesIO()
    Image.fromarray(decode_image(data, size=size, bit_depth=bit_depth, name=name)).save(file, "PNG", compress_level=1)
    return file.getvalue()


def describe_pictures(
    first: Mapping[str, Path], frames: Sequence[Mapping[str, Path]], bit_depth: int | None = None
) -> tuple[int | None, list[str]]:
    """Returns the bit depth of a capture's 16-bit images, and remarks for the user on its images.

    The remarks concern 16-bit images, files with several images, and greyscale cameras in a colour rig. They are based
    on the header of one file of each camera. Of 16-bit cameras, the images of several frames are decoded.

    Args:
        first: a readable image file of each camera.
        frames: the image files of each frame, keyed by camera name. Missing files are absent.
        bit_depth: number of bits that the values of 16-bit images use; None to find it (`find_bit_depth`).

    Returns:
        The bit depth, or None if there are no 16-bit images, and the remarks.

    Raises:
        ImageError: if an image in ``first`` cannot be read, or is rotated.
    """
    grey, several, deep = {}, [], []
    for camera, path in first.items():
        with _errors_of(str(path)), _open(path) as picture:
            grey[camera] = picture.mode in ("1", "L", "LA", "I;16")
            _check_orientation(picture)
            several += [camera] if getattr(picture, "n_frames", 1) > 1 else []
        with path.open("rb") as file:
            deep += [camera] if is_sixteen_bit(file.read(25)) else []
    remarks = mixed_colours(grey)
    if several:
        remarks.append(f"{_listed(several)}: files contain several images; only the first of each file is used")
    if not deep:
        return None, remarks
    depth = bit_depth
    if depth is None:
        sampled = frames[:: -(-len(frames) // SAMPLED_FRAMES)]
        depth = find_bit_depth(frame[camera] for frame in sampled for camera in deep if camera in frame)
    remarks.append(
        f"{_listed(deep)}: 16-bit images are converted to 8 bits from a bit depth of {depth}"
        + ("" if bit_depth else ", which was found from their values; if it is wrong, set --bit-depth")
    )
    return depth, remarks


def _listed(cameras: Sequence[str]) -> str:
    return f"camera {cameras[0]!r}" if len(cameras) == 1 else f"{len(cameras)} cameras, such as {cameras[0]!r}"


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


def _name(source: Source) -> str:
    return str(source) if isinstance(source, Path) else "image data"


def _open(source: Path | io.BytesIO, formats: tuple[str, ...] = FORMATS) -> Image.Image:
    return Image.open(source, formats=formats)


@contextmanager
def _errors_of(name: str) -> Iterator[None]:
    """Raises each error as `ImageError` with the name of the image. Pillow raises errors of many types."""
    try:
        yield
    except ImageError as error:
        raise ImageError(f"{name}: {error.fault}", error.remedy, error.value) from error
    except FileNotFoundError as error:
        raise ImageError(f"{name}: no such file") from error
    except UnidentifiedImageError as error:  # its message only names a buffer
        raise ImageError(f"{name} cannot be read as an image: it is damaged, or not {ACCEPTED}", RESEND) from error
    except Exception as error:
        raise ImageError(f"{name} cannot be read as an image ({type(error).__name__}: {error})", RESEND) from error


class _PictureFile:
    """Image file that follows the rules of this module.

    Its pixels are already decoded, unless its header shows that they can be.

    Args:
        source: image file, as bytes or as a path.
        name: name of the image in error messages.
        size: required (width, height), or None.
        mask: whether the file is a mask or a label image.

    Attributes:
        is_plain: whether the image is 8-bit RGB or grey without transparency, whose conversion to sRGB cannot fail.

    Raises:
        ImageError: if the file breaks a rule, or cannot be decoded.
    """

    def __init__(self, source: Source, name: str, size: Size | None, *, mask: bool = False) -> None:
        self._name = name
        with _errors_of(name):
            self._data = source.read_bytes() if isinstance(source, Path) else source
            self.header = picture_header(self._data)
            if mask and self.header.format not in MASK_FORMATS:
                raise ImageError(
                    f"masks must be PNG or BMP, not {self.header.format}",
                    "encode masks as PNG, which keeps their values exactly",
                    self.header.format,
                )
            # Before decoding, because a small file can declare a huge image. The orientation of a rotated image is
            # reported below.
            if size is not None and sorted(size) != sorted(self.header.size):
                raise _wrong_size(self.header, size)
            # Pillow, which takes longer than all other checks, would find nothing in a file that is decodable and has
            # no metadata, except that an image is huge.
            self._is_huge = math.prod(self.header.size) > (Image.MAX_IMAGE_PIXELS or math.inf)
            self.is_plain = self.header.decodable and not self.header.has_metadata and not self._is_huge
            self._to_srgb: Any = None
            if not self.is_plain:
                self._check_with_pillow(mask)
            if size not in (None, self.header.size):
                raise _wrong_size(self.header, size)

    @cached_property
    def _picture(self) -> Image.Image:
        return _open(io.BytesIO(self._data), (self.header.format,))

    @property
    def _is_simple_jpeg(self) -> bool:
        """Whether the image is a JPEG that simplejpeg decodes like Pillow, in less than half of its time.

        Such a JPEG can be decoded for certain, needs no colour conversion, and is not so large that Pillow would warn.
        """
        return self.header.format == "JPEG" and self.header.decodable and not self._is_huge and self._to_srgb is None

    def _check_with_pillow(self, mask: bool) -> None:
        if self._picture.size != self.header.size:
            raise ImageError("the file contains different image sizes", RESEND)
        profile = self._picture.info.get("icc_profile")
        self._to_srgb = _to_srgb(profile) if profile and not mask else None
        if not self.header.decodable:
            self._picture.load()
        _check_orientation(self._picture)
        plain = self._picture.mode in ("L", "RGB") and "transparency" not in self._picture.info
        self.is_plain = plain and self.header.bits <= 8

    def stored(self) -> NDArray[Any]:
        """Returns the values of a mask as stored, [H, W] or [H, W, C]; of a palette image, the indices."""
        with _errors_of(self._name):
            if self._picture.mode in ("LA", "PA", "RGBA", "La", "RGBa"):
                raise ImageError(
                    "a mask with an alpha channel is ambiguous", "use a single channel, with 0 for background", "alpha"
                )
            return np.asarray(self._picture)

    def rgb(self, bit_depth: int | None) -> NDArray[np.uint8]:
        """Returns the image [H, W, 3], converted to sRGB. For `bit_depth`, see `decode_image`."""
        with _errors_of(self._name):
            if self._is_simple_jpeg:
                with suppress(ValueError):  # a warning about a segment, which Pillow ignores
                    pixels: NDArray[np.uint8] = decode_jpeg(
                        self._data, "RGB", fastdct=False, fastupsample=False, strict=False
                    )
                    return pixels
            picture = self._picture if self.header.bits <= 8 else _eight_bits(self._data, bit_depth)
            if picture.mode not in ("1", "L", "LA", "P", "PA", "RGB", "RGBA"):
                raise ImageError(f"colour mode {picture.mode} is not supported", "use RGB or greyscale", picture.mode)
            transparent = picture.mode in ("LA", "PA", "RGBA") or "transparency" in picture.info
            picture = picture.convert("RGBA" if transparent else "RGB")
            alpha = np.asarray(picture.getchannel("A")).astype(np.uint32)[..., None] if transparent else None
            picture = picture.convert("RGB")
            if self._to_srgb is not None:
                picture = self._to_srgb.apply(picture)
            rgb: NDArray[np.uint8] = np.array(picture)
            return rgb if alpha is None else ((rgb * alpha + 127) // 255).astype(np.uint8)


def _wrong_size(header: PictureHeader, size: Size) -> ImageError:
    given = f"{header.size[0]}x{header.size[1]}"
    return ImageError(
        f"the image is {given} pixels, but its camera requires {size[0]}x{size[1]}",
        "use images of the size for which the camera was calibrated",
        given,
    )


def _check_orientation(picture: Image.Image) -> None:
    try:
        orientation = int(picture.getexif().get(EXIF_ORIENTATION, 1))
    except Exception:  # damaged metadata, which contains no orientation
        return
    if 2 <= orientation <= 8:  # some cameras write 0 for an unknown orientation
        raise ImageError(
            f"EXIF orientation is {orientation}; the intrinsics apply to the stored pixels and would not match a "
            "rotated image",
            "store the pixels in the calibrated orientation and remove the tag",
            str(orientation),
        )


def _eight_bits(data: bytes | memoryview, bit_depth: int | None) -> Image.Image:
    if bit_depth is None:
        depth = find_bit_depth([data])
        scale = "" if depth == 16 else f"; its values use {depth} bits, so multiply them by 255/{(1 << depth) - 1}"
        raise ImageError(
            "the PNG file has 16 bits per channel", f"convert the image to 8 bits per channel{scale}", "16 bits"
        )
    return Image.fromarray(to_eight_bits(sixteen_bit_values(data), bit_depth))


@lru_cache(16)
def _to_srgb(profile: bytes) -> Any:
    """Returns the Pillow transform from an ICC profile to sRGB, or None if no conversion is needed."""
    try:
        source: Any = ImageCms.ImageCmsProfile(io.BytesIO(profile))
        described = source.profile.profile_description or ""
        if source.profile.xcolor_space.strip() != "RGB" or "sRGB" in described:
            # A grey profile is only a tone curve. A conversion from sRGB to sRGB would only add
            # rounding errors.
            return None
        return ImageCms.buildTransform(
            source, ImageCms.createProfile("sRGB"), "RGB", "RGB", ImageCms.Intent.RELATIVE_COLORIMETRIC
        )
    except (ImageCms.PyCMSError, OSError) as error:
        raise ImageError(f"the ICC profile cannot be read ({error})", "convert the image to sRGB") from error
