// A headset for tests: two eyes with a fixed pose each, whose pictures can be read.
const [WIDTH, HEIGHT] = [160, 120];
const transform = (matrix, inverse) => ({ matrix: Float32Array.from(matrix.flat()), inverse: { matrix: Float32Array.from(inverse.flat()) } });

class FakeSession extends EventTarget {
  constructor(poses) {
    super();
    Object.assign(this, { poses, inputSources: [], callbacks: [], frames: 0 });
  }

  async updateRenderState({ baseLayer }) {
    this.layer = baseLayer;
  }

  async requestReferenceSpace(kind) {
    return { kind };
  }

  requestAnimationFrame(callback) {
    this.callbacks.push(callback);
    setTimeout(() => this.turn(), 10);
  }

  turn() {
    if (this.ended) return;
    const { head, eyes } = this.poses;
    const pose = { transform: transform(head.matrix, head.inverse),
      views: eyes.map((eye) => ({ ...eye, transform: transform(eye.matrix, eye.inverse), projectionMatrix: Float32Array.from(eye.projection.flat()) })) };
    for (const callback of this.callbacks.splice(0)) callback(performance.now(), { getViewerPose: () => pose });
    this.frames++;
  }

  async end() {
    if (this.ended) throw new Error("the session has ended already");
    this.ended = true;
    this.dispatchEvent(new Event("end"));
  }

  /** RGB of both eyes' pictures, side by side, the uppermost row first. */
  picture() {
    const { gl, framebuffer } = this.layer;
    const values = new Uint8Array(4 * 2 * WIDTH * HEIGHT);
    gl.bindFramebuffer(gl.FRAMEBUFFER, framebuffer);
    gl.readPixels(0, 0, 2 * WIDTH, HEIGHT, gl.RGBA, gl.UNSIGNED_BYTE, values);
    return [...values];
  }
}

window.XRWebGLLayer = class {
  constructor(session, gl) {
    this.gl = gl;
    const texture = gl.createTexture();
    gl.bindTexture(gl.TEXTURE_2D, texture);
    gl.texStorage2D(gl.TEXTURE_2D, 1, gl.RGBA8, 2 * WIDTH, HEIGHT);
    this.framebuffer = gl.createFramebuffer();
    gl.bindFramebuffer(gl.FRAMEBUFFER, this.framebuffer);
    gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0, gl.TEXTURE_2D, texture, 0);
  }

  getViewport({ eye }) {
    return { x: eye === "right" ? WIDTH : 0, y: 0, width: WIDTH, height: HEIGHT };
  }
};
Object.defineProperty(navigator, "xr", { value: {
  isSessionSupported: async (mode) => mode === "immersive-vr",
  async requestSession() {
    await window.permission;
    if (window.headsetRefuses) throw new Error(window.headsetRefuses);
    return (window.session = new FakeSession(window.headsetPoses));
  },
} });
