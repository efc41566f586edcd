"""Small videos whose frames show their number, in any codec and container that PyAV's FFmpeg writes."""

from __future__ import annotations

from fractions import Fraction

import numpy as np

from client.importers.video.reader import Video

SIZE = (64, 48)
RATE = 25
FRAMES = 20
X265 = "log-level=none:pools=none:frame-threads=1:keyint=6"


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
    path,
    codec,
    frames=range(FRAMES),
    *,
    pix_fmt="yuv420p",
    form=None,
    muxing=None,
    edit=None,
    draw=textured,
    fields=None,
    **options,
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
        fields: "tff" or "bff" to mark frames as interlaced, top or bottom field first.
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
            if fields:
                frame = interlaced(frame, fields)
            packets += stream.encode(frame)
        packets += stream.encode()
        for packet in edit(packets) if edit else packets:
            container.mux(packet)
    return path


def interlaced(frame, fields):
    """The frame, marked as interlaced."""
    import av

    graph = av.filter.Graph()
    source = graph.add_buffer(width=frame.width, height=frame.height, format=frame.format, time_base=frame.time_base)
    mark, sink = graph.add("setfield", fields), graph.add("buffersink")
    source.link_to(mark)
    mark.link_to(sink)
    graph.configure()
    graph.push(frame)
    return graph.pull()


def in_order(path):
    """The visible pictures, as PyAV decodes them from the start."""
    import av

    with av.open(str(path)) as container:
        return [frame.to_ndarray(format="rgb24") for frame in container.decode(video=0)]


def check(path, numbers):
    """Checks the count and the pictures of a video: in order, backwards and at random."""
    pictures = in_order(path)
    assert [number(picture) for picture in pictures] == list(numbers)
    video = Video(path)
    assert len(video) == len(pictures)
    count = len(pictures)
    jumps = np.random.default_rng(0).integers(0, count, 2 * count).tolist()
    for order in (range(count), range(count - 1, -1, -1), jumps, range(count // 2, count)):
        for index in order:
            assert np.array_equal(video.frame(index), pictures[index]), f"frame {index} of {list(order)}"
    video.close()
    fresh = Video(path)  # its first frame is reached by a seek
    assert np.array_equal(fresh.frame(count - 2), pictures[count - 2])
    fresh.close()
