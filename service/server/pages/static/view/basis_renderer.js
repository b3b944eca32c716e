/**
 * Draws the sum of coefficient images in WebGL2, in one pass: a half-float texture layer for each image, and a small texture of coefficients with a
 * row for each tile of the picture (docs/view.md). Pixels without object read nothing but their coverage.
 */

import { DISPLAY_SPACE, matrixBetween } from "./colour_spaces.js";
import { FrameTimer } from "./frame_timer.js";

const VERTEX = `#version 300 es
void main() {
  gl_Position = vec4(2.0 * vec2(gl_VertexID & 1, gl_VertexID >> 1) - 1.0, 0.0, 1.0);
}`;

const FRAGMENT = `#version 300 es
precision highp float;
precision highp sampler2DArray;
precision highp usampler2D;
uniform sampler2DArray basis;
uniform sampler2D matte;
uniform sampler2D coefficients;   // a column for each term; a row for each tile left of the wipe, then for each right of it
uniform usampler2D tiles;         // index of each tile
uniform int side;                 // of a tile, pixels
uniform int tileCount;
uniform int terms;
uniform float border;             // of the wipe, in pixels
uniform float height;
uniform float gain;
uniform mat3 rec709;              // from the working space
uniform vec3 backdrop;            // encoded
out vec4 colour;
void main() {
  ivec2 place = ivec2(gl_FragCoord.x, height - gl_FragCoord.y);  // the first row is at the top
  float cover = texelFetch(matte, place, 0).r;
  if (cover == 0.0) {
    colour = vec4(backdrop, 1.0);
    return;
  }
  vec3 sum = vec3(0.0);
  int row = int(texelFetch(tiles, place / side, 0).r) + (gl_FragCoord.x < border ? 0 : tileCount);
  for (int k = 0; k < terms; k++) {
    sum += texelFetch(coefficients, ivec2(k, row), 0).rgb * texelFetch(basis, ivec3(place, k), 0).rgb;
  }
  vec3 linear = clamp(rec709 * (gain * sum), 0.0, 1.0);
  vec3 encoded = mix(12.92 * linear, 1.055 * pow(linear, vec3(1.0 / 2.4)) - 0.055, vec3(greaterThan(linear, vec3(0.0031308))));
  colour = vec4(encoded + (1.0 - cover) * backdrop, 1.0);
}`;

/** Return whether this browser can relight. */
export function canRender() {
  return document.createElement("canvas").getContext("webgl2") !== null;
}

export class BasisRenderer {
  #gl;
  #places;

  /**
   * @param {HTMLCanvasElement} canvas As large as the coefficient images.
   * @param {any} relight Of view.json.
   * @param {string} space Working space of the coefficient images.
   * @param {Uint16Array} tiles Index of each tile.
   */
  constructor(canvas, relight, space, tiles) {
    const gl = canvas.getContext("webgl2", { antialias: false, preserveDrawingBuffer: true });
    this.#gl = gl;
    this.canvas = canvas;
    this.relight = relight;
    const program = link(gl, VERTEX, FRAGMENT);
    gl.useProgram(program);
    const names = ["height", "basis", "matte", "coefficients", "terms", "border", "gain", "rec709", "backdrop", "tiles", "side", "tileCount"];
    this.#places = Object.fromEntries(names.map((name) => [name, gl.getUniformLocation(program, name)]));
    gl.uniform1i(this.#places.basis, 0);
    gl.uniform1i(this.#places.matte, 1);
    gl.uniform1i(this.#places.coefficients, 2);
    gl.uniform1i(this.#places.tiles, 3);
    gl.uniform1i(this.#places.terms, relight.terms);
    gl.uniform1i(this.#places.side, relight.tiles.side);
    gl.uniform1i(this.#places.tileCount, relight.tiles.count);
    gl.uniformMatrix3fv(this.#places.rec709, true, matrixBetween(space, DISPLAY_SPACE));
    gl.activeTexture(gl.TEXTURE0);
    gl.bindTexture(gl.TEXTURE_2D_ARRAY, gl.createTexture());
    gl.texStorage3D(gl.TEXTURE_2D_ARRAY, 1, gl.RGBA16F, relight.cols, relight.rows, relight.terms);
    this.#sampling(gl.TEXTURE_2D_ARRAY);
    gl.activeTexture(gl.TEXTURE2);
    gl.bindTexture(gl.TEXTURE_2D, gl.createTexture());
    gl.texStorage2D(gl.TEXTURE_2D, 1, gl.RGB32F, relight.terms, 2 * relight.tiles.count);
    this.#sampling(gl.TEXTURE_2D);
    gl.pixelStorei(gl.UNPACK_ALIGNMENT, 1);
    gl.activeTexture(gl.TEXTURE3);
    gl.bindTexture(gl.TEXTURE_2D, gl.createTexture());
    gl.texImage2D(gl.TEXTURE_2D, 0, gl.R16UI, relight.tiles.cols, relight.tiles.rows, 0, gl.RED_INTEGER, gl.UNSIGNED_SHORT, tiles);
    this.#sampling(gl.TEXTURE_2D);
    this.timer = new FrameTimer(gl);
  }

  /** Take a coefficient image: half floats [3, rows, cols]. */
  setTerm(term, planes) {
    const gl = this.#gl;
    const { rows, cols } = this.relight;
    const count = rows * cols;
    const pixels = new Uint16Array(4 * count); // four channels are read faster than three
    for (let at = 0; at < count; at += 1) {
      pixels[4 * at] = planes[at];
      pixels[4 * at + 1] = planes[count + at];
      pixels[4 * at + 2] = planes[2 * count + at];
    }
    gl.activeTexture(gl.TEXTURE0);
    gl.texSubImage3D(gl.TEXTURE_2D_ARRAY, 0, 0, 0, term, cols, rows, 1, gl.RGBA, gl.HALF_FLOAT, pixels);
  }

  /** Take the coverage: bytes [rows, cols]. */
  setMatte(coverage) {
    const gl = this.#gl;
    gl.activeTexture(gl.TEXTURE1);
    gl.bindTexture(gl.TEXTURE_2D, gl.createTexture());
    gl.texImage2D(gl.TEXTURE_2D, 0, gl.R8, this.relight.cols, this.relight.rows, 0, gl.RED, gl.UNSIGNED_BYTE, coverage);
    this.#sampling(gl.TEXTURE_2D);
  }

  /**
   * Draw the picture.
   * @param {{shown: Float32Array, compared: Float32Array|null, border: number, gain: number, backdrop: number[]}} picture Coefficients
   * [tiles, terms, 3] left and right of the border (0 to 1; null: there is nothing right of it); gain; encoded colour behind the object.
   */
  draw({ shown, compared, border, gain, backdrop }) {
    const gl = this.#gl;
    const { width, height } = this.canvas;
    gl.viewport(0, 0, width, height);
    gl.uniform1f(this.#places.height, height);
    gl.activeTexture(gl.TEXTURE2);
    const { terms, tiles: { count } } = this.relight;
    [shown, compared].forEach((each, side) => each !== null && gl.texSubImage2D(gl.TEXTURE_2D, 0, 0, side * count, terms, count, gl.RGB, gl.FLOAT, each));
    gl.uniform1f(this.#places.border, compared === null ? width : border * width);
    gl.uniform1f(this.#places.gain, gain);
    gl.uniform3f(this.#places.backdrop, ...backdrop);
    this.timer.during(() => gl.drawArrays(gl.TRIANGLE_STRIP, 0, 4));
  }

  /** Return the bytes [height, width, 4] of what was drawn, from the top. */
  pixels() {
    const gl = this.#gl;
    const { width, height } = this.canvas;
    const upward = new Uint8Array(4 * width * height);
    gl.readPixels(0, 0, width, height, gl.RGBA, gl.UNSIGNED_BYTE, upward);
    const found = new Uint8Array(upward.length);
    for (let row = 0; row < height; row += 1) found.set(upward.subarray(4 * width * row, 4 * width * (row + 1)), 4 * width * (height - 1 - row));
    return found;
  }

  #sampling(target) {
    for (const name of [this.#gl.TEXTURE_MIN_FILTER, this.#gl.TEXTURE_MAG_FILTER]) this.#gl.texParameteri(target, name, this.#gl.NEAREST);
  }
}

function link(gl, vertex, fragmentText) {
  const program = gl.createProgram();
  for (const [kind, text] of [[gl.VERTEX_SHADER, vertex], [gl.FRAGMENT_SHADER, fragmentText]]) {
    const shader = gl.createShader(kind);
    gl.shaderSource(shader, text);
    gl.compileShader(shader);
    if (!gl.getShaderParameter(shader, gl.COMPILE_STATUS)) throw new Error(`the browser refused a shader: ${gl.getShaderInfoLog(shader)}`);
    gl.attachShader(program, shader);
  }
  gl.linkProgram(program);
  if (!gl.getProgramParameter(program, gl.LINK_STATUS)) throw new Error(`the browser refused the shaders: ${gl.getProgramInfoLog(program)}`);
  return program;
}
