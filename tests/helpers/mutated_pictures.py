"""Image files of all formats and kinds, and files made from them by damage and by rebuilding their structure."""

from __future__ import annotations

import functools
import io
import struct
import zlib

import numpy as np
from PIL import Image, ImageCms

WIDTH, HEIGHT = 24, 16
PNG_START = b"\x89PNG\r\n\x1a\n"


def encoded(picture, kind, **options):
    file = io.BytesIO()
    picture.save(file, kind, **options)
    return file.getvalue()


def exif(orientation):
    tags = Image.Exif()
    tags[0x0112] = orientation
    return tags


def png_chunk(kind, body):
    return struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))


def sixteen_bit_png(values, colour_type, **chunks):
    """A PNG of uint16 values [H, W] or [H, W, C]; Pillow writes only grey ones."""
    height, width = values.shape[:2]
    head = struct.pack(">IIBBBBB", width, height, 16, colour_type, 0, 0, 0)
    rows = b"".join(b"\0" + row.astype(">u2").tobytes() for row in values)
    more = b"".join(png_chunk(kind.encode(), body) for kind, body in chunks.items())
    return (
        PNG_START + png_chunk(b"IHDR", head) + more + png_chunk(b"IDAT", zlib.compress(rows)) + png_chunk(b"IEND", b"")
    )


def interlaced_png(rgb):
    passes = ((0, 0, 8, 8), (4, 0, 8, 8), (0, 4, 4, 8), (2, 0, 4, 4), (0, 2, 2, 4), (1, 0, 2, 2), (0, 1, 1, 2))
    rows = b"".join(b"\0" + row.tobytes() for x, y, dx, dy in passes for row in rgb[y::dy, x::dx])
    head = struct.pack(">IIBBBBB", rgb.shape[1], rgb.shape[0], 8, 2, 0, 0, 1)
    return PNG_START + png_chunk(b"IHDR", head) + png_chunk(b"IDAT", zlib.compress(rows)) + png_chunk(b"IEND", b"")


def adobe_like_profile():
    """A profile of a display with a gamma of 1.8, which must be converted."""
    data = bytearray(ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB")).tobytes())
    count = struct.unpack_from(">I", data, 128)[0]
    for entry in range(count):
        tag, offset, _ = struct.unpack_from(">4sII", data, 132 + 12 * entry)
        if tag in (b"rTRC", b"gTRC", b"bTRC"):
            data[offset : offset + 14] = struct.pack(">4sIIH", b"curv", 0, 1, round(1.8 * 256))
            struct.pack_into(">I", data, 132 + 12 * entry + 8, 14)
        if tag == b"desc":
            place = data.index("sRGB".encode("utf-16-be"), offset)
            data[place : place + 8] = "cam8".encode("utf-16-be")
    return bytes(data)


@functools.cache
def whole_files():
    """Files that are decoded or refused as they are, keyed by their kind."""
    rng = np.random.default_rng(0)
    smooth = np.linspace(0, 200, WIDTH)[None, :, None] + np.zeros((HEIGHT, 1, 3))
    rgb = (smooth + rng.integers(0, 55, smooth.shape)).astype(np.uint8)
    picture = Image.fromarray(rgb)
    grey, palette, bit = picture.convert("L"), picture.quantize(16), picture.convert("1")
    other = Image.fromarray(255 - rgb)
    alpha = picture.copy()
    alpha.putalpha(grey)
    profile = adobe_like_profile()
    deep = rng.integers(0, 4096, (HEIGHT, WIDTH, 4)).astype(np.uint16)
    animation = dict(save_all=True, append_images=[other])
    return {
        "JPEG": encoded(picture, "JPEG"),
        "JPEG 4:4:4": encoded(picture, "JPEG", subsampling=0, quality=95, optimize=True),
        "JPEG grey": encoded(grey, "JPEG"),
        "JPEG progressive": encoded(picture, "JPEG", progressive=True),
        "JPEG restarts": encoded(picture, "JPEG", restart_marker_blocks=1),
        "JPEG EXIF, ICC": encoded(picture, "JPEG", exif=exif(1), icc_profile=profile),
        "JPEG rotated": encoded(picture, "JPEG", exif=exif(6)),
        "JPEG CMYK": encoded(picture.convert("CMYK"), "JPEG"),
        "MPO": encoded(picture, "MPO", **animation),
        "PNG": encoded(picture, "PNG"),
        "PNG grey": encoded(grey, "PNG"),
        "PNG 1 bit": encoded(bit, "PNG"),
        "PNG palette": encoded(palette, "PNG", bits=4, transparency=3),
        "PNG alpha": encoded(alpha, "PNG"),
        "PNG interlaced": interlaced_png(rgb),
        "PNG EXIF, ICC": encoded(picture, "PNG", exif=exif(1), icc_profile=profile),
        "PNG rotated": encoded(picture, "PNG", exif=exif(8)),
        "PNG 16 bit": sixteen_bit_png(deep[..., :3], 2, sBIT=b"\x0c\x0c\x0c"),
        "PNG 16 bit grey": sixteen_bit_png(deep[..., 0], 0),
        "PNG animated": encoded(picture, "PNG", **animation),
        "WebP": encoded(picture, "WEBP"),
        "WebP lossless": encoded(picture, "WEBP", lossless=True),
        "WebP alpha": encoded(alpha, "WEBP"),
        "WebP EXIF, ICC": encoded(picture, "WEBP", exif=exif(1), icc_profile=profile),
        "WebP rotated": encoded(picture, "WEBP", exif=exif(6)),
        "WebP animated": encoded(picture, "WEBP", **animation),
        "BMP": encoded(picture, "BMP"),
        "BMP palette": encoded(palette, "BMP"),
        "BMP 1 bit": encoded(bit, "BMP"),
        "BMP 32 bit": encoded(alpha, "BMP"),
        "PPM": encoded(picture, "PPM"),
        "PGM": encoded(grey, "PPM"),
    }


def split(data):
    """Returns the parts of a file: chunks with kind and contents, segments, or a header and pixels."""
    if data.startswith(PNG_START):
        parts, at = [], 8
        while at + 8 <= len(data):
            (length,) = struct.unpack_from(">I", data, at)
            parts.append(data[at + 4 : at + 8 + length])
            at += 12 + length
        return parts
    if data.startswith(b"RIFF"):
        parts, at = [], 12
        while at + 8 <= len(data):
            (length,) = struct.unpack_from("<I", data, at + 4)
            parts.append(data[at : at + 4] + data[at + 8 : at + 8 + length])
            at += 8 + length + length % 2
        return parts
    if data.startswith(b"\xff\xd8"):
        starts, at = [2], 2
        while (at := data.find(b"\xff", at + 1)) >= 0:
            # A segment ends where its length says; a scan at the next marker.
            if data[at + 1 : at + 2] not in (b"\0", b"") and data[starts[-1] + 1] == 0xDA:
                starts.append(at)
            elif data[starts[-1] + 1] != 0xDA:
                at = starts[-1] + 2 + struct.unpack_from(">H", data, starts[-1] + 2)[0]
                starts.append(at)
        return [data[start:end] for start, end in zip(starts, [*starts[1:], len(data)], strict=True)]
    head = 54 if data.startswith(b"BM") else 13
    return [data[:head], data[head:]]


def join(parts, data):
    """Returns a file of parts, with lengths and checksums that fit; `data` has its format."""
    if data.startswith(PNG_START):
        return PNG_START + b"".join(png_chunk(part[:4], part[4:]) for part in parts)
    if data.startswith(b"RIFF"):
        body = b"".join(
            part[:4] + struct.pack("<I", len(part[4:])) + part[4:] + b"\0" * (len(part) % 2) for part in parts
        )
        return b"RIFF" + struct.pack("<I", 4 + len(body)) + b"WEBP" + body
    return (b"\xff\xd8" if data.startswith(b"\xff\xd8") else b"") + b"".join(parts)


def flip(rng, data, other):
    damaged = bytearray(data)
    for at in rng.integers(0, len(data), rng.integers(1, 9)):
        damaged[at] ^= 1 << rng.integers(8)
    return bytes(damaged)


def overwrite(rng, data, other):
    at, length = rng.integers(len(data)), rng.integers(1, 9)
    return data[:at] + rng.bytes(length) + data[at + length :]


def cut(rng, data, other):
    return data[: rng.integers(len(data))]


def cut_at_a_part(rng, data, other):
    parts = split(data)
    return join(parts[: rng.integers(len(parts))], data)


def cut_and_end(rng, data, other):
    """Loses bytes, but has the end of a whole file."""
    at = rng.integers(len(data))
    return data[:at] + data[rng.integers(at, len(data)) :]


def insert(rng, data, other):
    at = rng.integers(len(data))
    return data[:at] + rng.bytes(rng.integers(1, 40)) + data[at:]


def repeat(rng, data, other):
    begin, end = sorted(rng.integers(0, len(data), 2))
    return data[:end] + data[begin:end] + data[end:]


def append(rng, data, other):
    return data + (other if rng.integers(2) else rng.bytes(rng.integers(1, 60)))


def insert_another(rng, data, other):
    at = rng.integers(len(data))
    return data[:at] + other + data[at:]


def reorder(rng, data, other):
    parts = split(data)
    first, second = rng.integers(0, len(parts), 2)
    parts[first], parts[second] = parts[second], parts[first]
    return join(parts, data)


def drop_a_part(rng, data, other):
    parts = split(data)
    del parts[rng.integers(len(parts))]
    return join(parts, data)


def repeat_a_part(rng, data, other):
    parts = split(data)
    parts.insert(rng.integers(len(parts) + 1), parts[rng.integers(len(parts))])
    return join(parts, data)


def borrow_a_part(rng, data, other):
    """Has a part of another file, mostly of another format."""
    parts, others = split(data), split(other)
    at = rng.integers(len(parts))
    parts[at : at + rng.integers(2)] = [others[rng.integers(len(others))]]
    return join(parts, data)


def damage_a_part(rng, data, other):
    """Changes, shortens or lengthens a part, whose checksum and length fit."""
    parts = split(data)
    at = rng.integers(len(parts))
    if parts[at]:
        parts[at] = (flip, overwrite, cut, insert)[rng.integers(4)](rng, parts[at], other)
    return join(parts, data)


def damage_a_field(rng, data, other):
    """Changes one of the first bytes of a part: sizes, depths, counts, indices of tables."""
    parts = split(data)
    at = rng.integers(len(parts))
    if len(parts[at]) > 1:
        part, place = bytearray(parts[at]), rng.integers(min(24, len(parts[at])))
        part[place] = (0, 1, 2, 3, 4, 8, 16, 32, 127, 128, 255, part[place] ^ 1)[rng.integers(12)]
        parts[at] = bytes(part)
    return join(parts, data)


def change_the_size(rng, data, other):
    """Declares another width or height, and mostly the right one elsewhere."""
    width, height = (int(length) for length in (WIDTH, HEIGHT) + rng.integers(-1, 2, 2) * rng.integers(1, 300))
    for form in (">II", ">HH", "<HH", "<ii"):
        for old in ((WIDTH, HEIGHT), (HEIGHT, WIDTH)):
            new = (width, height) if old == (WIDTH, HEIGHT) else (height, width)
            if struct.pack(form, *old) in data and min(new) >= 0 and data[:2] not in (b"P5", b"P6"):
                changed = data.replace(struct.pack(form, *old), struct.pack(form, *new), 1)
                return join(split(changed), data)
    return data.replace(b"24 16", b"%d %d" % (width, height))


def damage_the_pixels(rng, data, other):
    """Changes the compressed rows of a PNG before compression: filters, values, length."""
    parts = split(data)
    places = [at for at, part in enumerate(parts) if part[:4] == b"IDAT"]
    if not data.startswith(PNG_START) or not places:
        return damage_a_part(rng, data, other)
    rows = zlib.decompress(parts[places[0]][4:])
    rows = (flip, overwrite, cut, insert)[rng.integers(4)](rng, rows, other)
    parts[places[0]] = b"IDAT" + zlib.compress(rows)
    return join(parts, data)


def no_end(rng, data, other):
    return data[: rng.integers(0, min(len(data), 34))] if rng.integers(4) else b""


MUTATIONS = (
    flip, overwrite, cut, cut_at_a_part, cut_and_end, insert, repeat, append, insert_another, reorder, drop_a_part,
    repeat_a_part, borrow_a_part, damage_a_part, damage_a_field, change_the_size, damage_the_pixels, no_end,
)  # fmt: skip


def mutated(number):
    """Returns the name and the contents of a mutated file. The first numbers are the whole files."""
    files = list(whole_files().items())
    if number < len(files):
        return files[number]
    rng = np.random.default_rng(number)
    name, data = files[number % len(files)]
    other = files[rng.integers(len(files))][1]
    mutation = MUTATIONS[rng.integers(len(MUTATIONS))]
    data = mutation(rng, data, other)
    if not rng.integers(4) and data:
        second = MUTATIONS[rng.integers(5)]
        data = second(rng, data, other) if second not in (cut_at_a_part,) else data
    return f"{name}, {mutation.__name__}", data
