"""Small videos whose frames show their number, in any codec and container that PyAV's FFmpeg writes."""

from __future__ import annotations

from fractions import Fraction

import numpy as np

SIZE = (64, 48)
RATE = 25


def barcode(index, size=SIZE):
    """A picture that shows its number in eight broad bars: it survives any encoder."""
    picture = np.zeros((size[1], size[0], 3), np.uint8)
    for bit in range(8):
        picture[:, size[0] * bit // 8 : size[0] * (bit + 1) // 8] = 230 * (index >> bit & 1) + 10
    return picture


def number(picture):
    width = picture.shape[1]
    return sum(int(picture[:, width * (2 * bit + 1) // 16].mean() > 128) << bit for bit in range(8))


def textured(index, size=SIZE):
    """A barcode over moving noise, so that a picture decoded without its references differs from the right one."""
    noise = np.random.default_rng(index).integers(-9, 10, (size[1], size[0], 1))
    return np.clip(barcode(index, size) + noise, 0, 255).astype(np.uint8)


def encode(
    path, codec, frames=range(20), *, pix_fmt="yuv420p", form=None, muxing=None, edit=None, draw=textured, **options
):
    """Writes a video of numbered frames.

    Args:
        path: file to write.
        codec: name of the encoder.
        frames: numbers of the frames.
        pix_fmt: pixel format.
        form: container format; None to take it from the suffix.
        muxing: options of the muxer.
        edit: function from the list of packets to the list that is written; None for all of them.
        draw: function from a number to a picture.
        options: options of the encoder, or attributes of PyAV's codec context.
    """
    import av

    path.parent.mkdir(parents=True, exist_ok=True)
    with av.open(str(path), "w", format=form, options=muxing or {}) as container:
        stream = container.add_stream(codec, rate=RATE)
        height, width = draw(frames[0]).shape[:2]
        stream.width, stream.height, stream.pix_fmt = width, height, pix_fmt
        stream.codec_context.thread_count = 1
        stream.options = {name: str(value) for name, value in options.items()}
        packets = []
        for place, index in enumerate(frames):
            picture = draw(index)
            if pix_fmt == "pal8":  # with a palette of greys
                palette = np.repeat(np.arange(256, dtype=np.uint8)[:, None], 4, axis=1)
                frame = av.VideoFrame.from_ndarray((picture[..., 0].copy(), palette), "pal8")
            else:
                frame = av.VideoFrame.from_ndarray(picture, "rgb24").reformat(format=pix_fmt)
            frame.pts, frame.time_base = place, Fraction(1, RATE)
            packets += stream.encode(frame)
        packets += stream.encode()
        for packet in edit(packets) if edit else packets:
            container.mux(packet)
    return path
