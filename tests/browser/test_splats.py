"""The page's own reader of compact files and its painter, against the Python reader and the CPU rasterizer."""

from __future__ import annotations

import base64
import io

import browser_engine
import numpy as np
import pytest
from export_cases import bent
from PIL import Image
from splat_pictures import psnr, rendered

from scas4d_core.compact import CompactReader, CompactWriter, FileHeader
from scas4d_core.compact.columns import Columns
from scas4d_core.compact.records import RecordKind
from scas4d_core.gaussians import Gaussians

ATTRIBUTES = ("means", "factors", "rotations", "colours", "foreground", "opacities", "retired", "ids")
PRELUDE = """async ([data, order]) => {
  const { CompactReader } = await import('/viewer/splats/reader.js');
  const bytes = Uint8Array.from(atob(data), (one) => one.charCodeAt(0));
"""
READ = """
  const text = (array) => {
    let all = '';
    for (const one of new Uint8Array(array.slice().buffer)) all += String.fromCharCode(one);
    return btoa(all);
  };
  const reader = new CompactReader(bytes);
  const state = (place) => Object.fromEntries(NAMES.map((name) => [name, text(reader.state(place)[name])]));
  const parts = reader.parts() && [...reader.parts()];
  return { frames: reader.frames, times: reader.times, damage: reader.damage, parts,
    states: order.map((place) => [place, state(place)]) };
}""".replace("NAMES", str(list(ATTRIBUTES)))
GROW = READ.replace(
    "const reader = new CompactReader(bytes);",
    """
  const [ends, last, trims] = order.splice(0, 3);
  const reader = new CompactReader(bytes.slice(0, ends[0]));
  ends.slice(1).forEach((end, k) => {
    reader.append(bytes.slice(ends[k], end));
    reader.state(k + 1);
  });
  if (trims) reader.trim();
  order.push(reader.frames.indexOf(last));
""",
)
PAINT = """
  const { Painter } = await import('/viewer/splats/painter.js');
  const { Sorter } = await import('/viewer/splats/sort.js');
  const { Sequence } = await import('/viewer/splats/sequence.js');
  const { inside, nearOf } = await import('/viewer/splats/rig.js');
  const { Rasterizer } = await import('/viewer/splats/software.js');
  const { place, model, software, hiddenPart, ramp } = order;
  const sequence = new Sequence();
  const reader = new CompactReader(bytes);
  sequence.add(reader);
  const hidden = hiddenPart === null ? null : Uint8Array.from(reader.parts(), (part) => (part === hiddenPart ? 1 : 0));
  const canvas = document.createElement('canvas');
  const [painter, sorter] = [new Painter(canvas), new Sorter()];
  const camera = inside(model, sequence.head, nearOf(sequence.head));
  const moment = sequence.moment(place);
  const { background } = sequence.head;
  const paint = ramp ? Uint8Array.from({ length: 4 * (moment.to ?? moment.from).count }, (_, k) => k % 251) : 'own';
  sorter.sort(moment, camera.rows[2], hidden);
  painter.size(camera.width, camera.height);
  if (software) painter.show(new Rasterizer().paint(moment, camera, sorter, paint, background));
  else {
    painter.project(moment, camera, sorter, paint);
    painter.colours(background);
  }
  return { png: canvas.toDataURL('image/png').split(',')[1] };
}"""

BOUND = """async () => {
  const { Sequence } = await import('/viewer/splats/sequence.js');
  const state = { count: 1 };
  const file = (first) => ({ frames: [first, first + 1], times: [0, 1], head: {}, bytes: new Uint8Array(100),
    state: () => state, forget() {} });
  const firsts = (sequence) => sequence.frames.map((frame) => frame.index).filter((index) => index % 10 === 0);
  const show = (sequence, index) => sequence.moment(sequence.frames.findIndex((frame) => frame.index === index));
  const [back, again, offline] = [new Sequence(250), new Sequence(250), new Sequence(Infinity)];
  for (const first of [40, 30, 20, 10]) back.add(file(first)), show(back, first);
  again.add(file(0)), again.add(file(30)), show(again, 0), again.add(file(10)); // 0 came first, and is shown
  for (const first of [0, 10, 20, 30]) offline.add(file(first));
  const one = new Sequence(50); // less than a file
  one.add(file(0)), show(one, 0), one.add(file(10));
  return [back, again, offline, one].map(firsts);
}"""

TRAILS = """async () => {
  const { Painter } = await import('/viewer/splats/painter.js');
  const { Ways } = await import('/viewer/splats/trails.js');
  const size = 8;
  const painter = new Painter(Object.assign(document.createElement('canvas'), { width: size, height: size }));
  painter.size(size, size);
  const state = (x) => ({ count: 1, means: [x, 0, 1], foreground: [1], retired: [0] }); // goes right by a pixel a frame
  const frames = (...all) => all.map(([index, reader]) => ({ index, reader }));
  const ways = new Ways();
  ways.begin(state(0), 1, null);
  const camera = { rows: [[1, 0, 0], [0, 1, 0], [0, 0, 1]], t: [0, 0, 0], fx: 1, fy: 1, cx: 0.5, cy: 4.5,
    width: size, height: size, near: 0.1 };
  let sent = 0;
  const { gl } = painter;
  const send = gl.texSubImage2D.bind(gl);
  gl.texSubImage2D = (...given) => (given[5] === 1 && given[7] === gl.FLOAT && sent++, send(...given));
  const painted = (all) => {
    painter.placeTrails(ways, all);
    gl.clearColor(0, 0, 0, 1);
    gl.clear(gl.COLOR_BUFFER_BIT);
    gl.viewport(0, 0, size, size);
    painter.paintTrails(camera, all.length - 1, 30);
    const row = new Uint8Array(4 * size);
    gl.readPixels(0, 3, size, 1, gl.RGBA, gl.UNSIGNED_BYTE, row);
    const found = [[...Array(size).keys()].filter((x) => row[4 * x] + row[4 * x + 1] + row[4 * x + 2] > 0), sent];
    sent = 0;
    return found;
  };
  for (const [index, x] of [[0, 0], [1, 1], [2, 2], [8, 5], [9, 6]]) ways.add(index, state(x));
  const answers = [painted(frames([0, 'a'], [1, 'a'], [2, 'a']))];
  answers.push(painted(frames([0, 'a'], [1, 'a'], [2, 'a'], [8, 'b'], [9, 'b']))); // a gap between files
  ways.add(3, state(3));
  answers.push(painted(frames([0, 'a'], [1, 'a'], [2, 'a'], [3, 'c'], [8, 'b'], [9, 'b']))); // one came in between
  answers.push(painted(frames([0, 'a'], [1, 'a'], [2, 'a'], [8, 'a'], [9, 'a']))); // of one file: frames were left out
  return answers;
}"""


@pytest.fixture(scope="module")
def file(tmp_path_factory):
    return bent.write(tmp_path_factory.mktemp("bent") / "bent.s4d", browser_engine.make_rig())


def run(page, service, script, data, order):
    if page.url == "about:blank":
        page.goto(service.url)
    return page.evaluate(PRELUDE + script, [base64.b64encode(data).decode(), order])


def same(found, state):
    """Whether a state in JavaScript has the values of the Python reader, but for the last digits of float32."""
    columns = Columns.of(state)
    kinds = {"retired": np.uint8, "ids": np.float64}
    sizes = columns.sizes()
    for name in ATTRIBUTES:
        mine = np.frombuffer(base64.b64decode(found[name]), kinds.get(name, np.float32))
        true = np.asarray(getattr(columns, name)).astype(np.float64)
        error = np.abs(mine.reshape(true.shape) - true)
        if name in ("means", "factors"):
            error = error / np.maximum(sizes, 1e-3)
        assert error.max() < 2e-4, (name, error.max())


def test_all_frames_are_read_as_python_reads_them(page, service, file):
    order = [6, 2, 3, 0, 5, 1, 4]
    found = run(page, service, READ, file.read_bytes(), order)
    with CompactReader(file) as reader:
        assert found["frames"] == reader.frames
        assert found["times"] == reader.times.tolist()
        assert found["parts"] == reader.parts().tolist()
        assert found["damage"] is None
        counts = set()
        for place, state in found["states"]:
            same(state, reader.state(reader.frames[place]))
            counts.add(len(base64.b64decode(state["opacities"])) // 4)
    assert counts == {bent.BORN, bent.BORN + bent.LATER}


@pytest.mark.parametrize("trims", [False, True])
def test_a_file_that_grows_is_read_frame_by_frame(page, service, file, trims):
    data = file.read_bytes()
    with CompactReader(file) as reader:
        last = reader.frames[-1]
        ends = [reader._states[place].end for place in range(len(reader.frames))]
        found = run(page, service, GROW, data, [ends, last, trims])
        same(found["states"][0][1], reader.state(last))
        keys = [place for place, record in enumerate(reader._states) if record.kind is RecordKind.KEY]
        key = next(place for place in keys if place >= len(ends) / 2)
        kept = [0, *range(key, len(ends))] if trims else range(len(ends))
        assert found["frames"] == [reader.frames[place] for place in kept]


def test_a_file_that_was_cut_is_read_up_to_there(page, service, file):
    data = file.read_bytes()
    cut = data[: len(data) * 3 // 4]
    shorter = file.with_name("cut.s4d")
    shorter.write_bytes(cut)
    with CompactReader(shorter) as reader:
        last = len(reader.frames) - 1
        assert 0 < last < bent.FRAMES - 1
        found = run(page, service, READ, cut, [last])
        assert found["frames"] == reader.frames
        same(found["states"][0][1], reader.state(reader.frames[last]))


@pytest.mark.parametrize(
    ("damage", "words"),
    [
        (lambda data: b"PNG" + data[3:], "not a compact 4D file"),
        (lambda data: data.replace(b'"version": 1', b'"version": 9'), "damaged or truncated"),
        (lambda data: data[:400], "damaged or truncated"),
    ],
)
def test_what_is_no_such_file_is_refused_with_the_reason(page, service, file, damage, words):
    with pytest.raises(Exception, match=words):
        run(page, service, READ, damage(file.read_bytes()), [0])


def test_trails_are_kept_as_frames_come_and_broken_at_gaps(page, service):
    page.goto(service.url)
    (whole, all_sent), (broken, two_sent), (filled, three_sent), (joined, _) = page.evaluate(TRAILS)
    assert (all_sent, two_sent, three_sent) == (3, 2, 3)
    assert {0, 1} <= set(whole) <= {0, 1, 2}
    assert 5 in broken
    assert not {3, 4} & set(broken)
    assert {2, 5} <= set(filled)
    assert 4 not in filled
    assert {3, 4} <= set(joined)


def test_files_are_forgotten_by_when_they_were_shown(page, service):
    page.goto(service.url)
    assert page.evaluate(BOUND) == [[10, 20], [0, 10], [0, 10, 20, 30], [0, 10]]


def view(number, width, height, scale):
    camera = browser_engine.make_rig().cameras[number]
    intrinsics = (np.array([[scale], [scale], [1]]) * camera.intrinsics).tolist()
    pose = camera.world_to_camera.tolist()
    return {"intrinsics": intrinsics, "world_to_camera": pose, "width": width, "height": height}


def painted(page, service, file, place, model, software, hidden_part=None, ramp=False):
    """The picture of the page's shaders, or of its software rasterizer."""
    order = {"place": place, "model": model, "software": software, "hiddenPart": hidden_part, "ramp": ramp}
    found = run(page, service, PAINT, file.read_bytes(), order)
    return np.array(Image.open(io.BytesIO(base64.b64decode(found["png"]))).convert("RGB")) / 255


@pytest.mark.parametrize("software", [False, True])
@pytest.mark.parametrize(
    ("number", "place", "hidden_part"),
    [(0, 3, None), (4, 3, None), (2, 0, None), (1, 6, None), (0, 3, 1), (3, 6, 0)],  # three are retired at place 3
)
def test_pictures_agree_with_the_cpu_rasterizer(page, service, file, number, place, hidden_part, software):
    model = view(number, 256, 192, 8)
    mine = painted(page, service, file, place, model, software, hidden_part)
    with CompactReader(file) as reader:
        index = reader.frames[place]
    true = rendered(file, index, model, hidden_part)
    assert true.std() > 0.1  # it shows something
    assert psnr(mine, true) > 44
    assert np.abs(mine - true).max() < 0.1
    if hidden_part is not None:
        assert psnr(mine, rendered(file, index, model)) < 35


@pytest.mark.parametrize("software", [False, True])
def test_many_faint_layers_are_not_rounded_away(page, service, tmp_path, software):
    """Blending in 8 bits reaches only 52 dB here, and 34 dB in scenes with walls."""
    rig, draw = browser_engine.make_rig(), np.random.default_rng(0)
    state = Gaussians.of_points(
        draw.normal(scale=0.4, size=(3000, 3)), radius=0.2, colours=draw.uniform(size=(3000, 3))
    )
    with CompactWriter(tmp_path / "faint.s4d", FileHeader(rig.world_frame(2.0), rig=rig)) as writer:
        writer.add(0, 0.0, state.replace(opacities=draw.uniform(0.02, 0.05, size=3000).astype(np.float32)))
    model = view(0, 256, 192, 8)
    mine = painted(page, service, writer.path, 0, model, software)
    assert psnr(mine, rendered(writer.path, 0, model)) > 58


@pytest.mark.parametrize("software", [False, True])
def test_a_place_between_frames_is_between_them(page, service, file, software):
    model = view(1, 128, 96, 4)

    def at(place):
        return painted(page, service, file, place, model, software)

    before, between, after = at(1), at(1.5), at(2)
    assert np.abs(at(1.9999) - after).max() < 0.02  # goes on into the next frame
    with CompactReader(file) as reader:
        whole = rendered(file, reader.frames[1], model)  # and begins with the frame itself
    assert psnr(before, whole) > 40
    off = [np.abs(one - between).mean() for one in (before, after)]
    assert max(off) < 0.8 * np.abs(before - after).mean()
    assert min(off) > 0


def test_shaders_and_software_agree_between_frames_and_in_other_colours(page, service, file):
    """Gaussians are born between places 1 and 2, and three retire between 2 and 3."""
    own = None
    for place, ramp in [(1.5, False), (2.4, False), (2.4, True)]:
        shaders, software = (
            painted(page, service, file, place, view(0, 256, 192, 8), one, ramp=ramp) for one in (False, True)
        )
        assert psnr(shaders, software) > 44
        assert own is None or np.abs(shaders - own).max() > 0.1
        own = shaders
