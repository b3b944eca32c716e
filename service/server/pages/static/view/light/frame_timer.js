/** How fast pictures are drawn: the time between them, and that of the graphics processor where the browser tells it. */

const KEPT = 60; // drawings that the figures are of
const PAUSE_MS = 500; // drawings further apart are no motion

export class FrameTimer {
  #gl;
  #extension;
  #waiting = []; // queries without a result yet
  #gpuMs = [];
  #intervalsMs = [];
  #last = null;

  /** @param {WebGL2RenderingContext} gl */
  constructor(gl) {
    this.#gl = gl;
    this.#extension = gl.getExtension("EXT_disjoint_timer_query_webgl2");
  }

  /** Draw, and take the time of the graphics processor. */
  during(draw) {
    const gl = this.#gl;
    const now = performance.now();
    if (this.#last !== null && now - this.#last < PAUSE_MS) keep(this.#intervalsMs, now - this.#last);
    else this.#intervalsMs = [];
    this.#last = now;
    this.#collect();
    const query = this.#extension === null || this.#waiting.length > KEPT ? null : gl.createQuery();
    if (query !== null) gl.beginQuery(this.#extension.TIME_ELAPSED_EXT, query);
    draw();
    if (query !== null) {
      gl.endQuery(this.#extension.TIME_ELAPSED_EXT);
      this.#waiting.push(query);
    }
  }

  /**
   * Return the figures of the motion that is going on, or went on last: pictures a second, null before there were three; and the median milliseconds of
   * the graphics processor, null where the browser does not tell them.
   */
  figures() {
    this.#collect();
    const mean = this.#intervalsMs.reduce((sum, each) => sum + each, 0) / this.#intervalsMs.length;
    const sorted = this.#gpuMs.toSorted((a, b) => a - b);
    return { framesPerSecond: this.#intervalsMs.length < 2 ? null : 1000 / mean, gpuMs: sorted.length === 0 ? null : sorted[Math.floor(sorted.length / 2)] };
  }

  #collect() {
    const gl = this.#gl;
    while (this.#waiting.length > 0 && gl.getQueryParameter(this.#waiting[0], gl.QUERY_RESULT_AVAILABLE)) {
      const query = this.#waiting.shift();
      if (!gl.getParameter(this.#extension.GPU_DISJOINT_EXT)) keep(this.#gpuMs, gl.getQueryParameter(query, gl.QUERY_RESULT) / 1e6);
      gl.deleteQuery(query);
    }
  }
}

function keep(values, value) {
  values.push(value);
  if (values.length > KEPT) values.shift();
}
