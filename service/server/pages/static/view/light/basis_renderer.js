/**
 * Draws the sum of coefficient images in WebGL2, in one pass: a half-float texture layer for each image, and a small texture of coefficients with a
 * row for each tile of the picture (docs/view.md). Pixels without object read nothing but their coverage.
 */

import { breath } from "../../breath.js";
import { DISPLAY_SPACE, matrixBetween } from "../colour_spaces.js";
import { FrameTimer } from "./frame_timer.js";

const VERTEX = `#version 300 es
void main() {
  gl_Position = vec4(2.0 * vec2(gl_VertexID & 1, gl_VertexID >> 1) - 1.0, 0.0, 1.0);
}`;

const FRAGMENT = `#version 300 es
precision highp float;
precision highp sampler2DArray;
precision highp usampler2D;
precision highp sampler3D;
uniform sampler2DArray basis;
uniform sampler2D matte;
uniform sampler2D coefficients;   // a column for each term; a row for each tile left of the wipe, then for each right of it
uniform usampler2D tiles;         // index of each tile
uniform int side;                 // of a tile, pixels
uniform int tileCount;
uniform int terms;
uniform float border;             // of the wipe, in pixels
uniform int stride;               // pixels of the capture in a row, of which one is drawn
uniform float height;             // of what is drawn
uniform float gain;
uniform sampler3D table;          // of a view transform, over the stops of red, green and blue
uniform vec3 range;               // of the table: whether it is used, its first stop, its stops
uniform mat3 rec709;              // from the working space
uniform vec3 backdrop;            // encoded
out vec4 colour;
void main() {
  ivec2 place = ivec2(gl_FragCoord.x, height - gl_FragCoord.y) * stride + stride / 2;  // the first row is at the top
  place = min(place, textureSize(matte, 0) - 1);
  float cover = texelFetch(matte, place, 0).r;
  if (cover == 0.0) {
    colour = vec4(backdrop, 1.0);
    return;
  }
  vec3 sum = vec3(0.0);
  int row = int(texelFetch(tiles, place / side, 0).r) + (float(place.x) + 0.5 < border ? 0 : tileCount);
  for (int k = 0; k < terms; k++) {
    sum += texelFetch(coefficients, ivec2(k, row), 0).rgb * texelFetch(basis, ivec3(place, k), 0).rgb;
  }
  vec3 scene = rec709 * (gain * sum);
  vec3 encoded;
  if (range.x > 0.0) {
    float side = float(textureSize(table, 0).x);
    vec3 stops = clamp((log2(max(scene, 1e-6)) - range.y) / range.z, 0.0, 1.0);
    encoded = texture(table, (0.5 + stops * (side - 1.0)) / side).rgb * cover;
  } else {
    vec3 linear = clamp(scene, 0.0, 1.0);
    encoded = mix(12.92 * linear, 1.055 * pow(linear, vec3(1.0 / 2.4)) - 0.055, vec3(greaterThan(linear, vec3(0.0031308))));
  }
  colour = vec4(encoded + (1.0 - cover) * backdrop, 1.0);
}`;

const SLICE = 1 << 17; // pixels that are put into a texture at once
const LOOK_MS = 4; // between two looks whether they are there

/** Return whether this browser can relight, on a canvas if one is given. */
export function canRender(canvas = document.createElement("canvas")) {
  return contextOf(canvas) !== null;
}

function contextOf(canvas) {
  return canvas.getContext("webgl2", { antialias: false, preserveDrawingBuffer: true });
}

export class BasisRenderer {
  #gl;
  #places;
  #put = 0; // pixels of coefficient images since the graphics processor was last waited for

  /**
   * @param {HTMLCanvasElement} canvas As large as the coefficient images.
   * @param {any} relight Of view.json.
   * @param {string} space Working space of the coefficient images.
   */
  constructor(canvas, relight, space) {
    const gl = contextOf(canvas);
    this.#gl = gl;
    this.canvas = canvas;
    this.relight = relight;
    const program = link(gl, VERTEX, FRAGMENT);
    gl.useProgram(program);
    const names = ["height", "basis", "matte", "coefficients", "terms", "border", "gain", "rec709", "backdrop", "tiles", "side", "tileCount", "stride", "table", "range"];
    this.#places = Object.fromEntries(names.map((name) => [name, gl.getUniformLocation(program, name)]));
    gl.uniform1i(this.#places.basis, 0);
    gl.uniform1i(this.#places.matte, 1);
    gl.uniform1i(this.#places.coefficients, 2);
    gl.uniform1i(this.#places.tiles, 3);
    gl.uniform1i(this.#places.table, 4);
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
    this.setView(null);
    this.timer = new FrameTimer(gl);
  }

  /** Take a coefficient image, half floats [3, rows, cols], some rows at a time, between which the page answers its user. */
  async setTerm(term, planes) {
    const gl = this.#gl;
    const { rows, cols } = this.relight;
    const count = rows * cols;
    const most = Math.max(1, Math.floor(SLICE / cols));
    const pixels = new Uint16Array(4 * cols * Math.min(most, rows)); // four channels are read faster than three
    for (let row = 0; row < rows; row += most) {
      const some = Math.min(most, rows - row);
      for (let at = 0, from = row * cols; at < some * cols; at += 1, from += 1) {
        pixels[4 * at] = planes[from];
        pixels[4 * at + 1] = planes[count + from];
        pixels[4 * at + 2] = planes[2 * count + from];
      }
      gl.activeTexture(gl.TEXTURE0);
      gl.texSubImage3D(gl.TEXTURE_2D_ARRAY, 0, 0, row, term, cols, some, 1, gl.RGBA, gl.HALF_FLOAT, pixels);
      this.#put += cols * some;
      if (this.#put < 2 * SLICE) await breath();
      else await this.#isThere(); // else the page would wait for the graphics processor when there is no more room for what it has yet to take
    }
  }

  async #isThere() {
    this.#put = 0;
    const fence = this.fence();
    while (!this.isPast(fence)) await new Promise((resolve) => { setTimeout(resolve, LOOK_MS); });
  }

  /** Take the coverage: bytes [rows, cols]. */
  setMatte(coverage) {
    this.#setTable(1, this.relight, ["R8", "RED", "UNSIGNED_BYTE"], coverage);
  }

  /** Take the index of each tile. */
  setTiles(index) {
    this.#setTable(3, this.relight.tiles, ["R16UI", "RED_INTEGER", "UNSIGNED_SHORT"], index);
  }

  #setTable(unit, { rows, cols }, names, values) {
    const gl = this.#gl;
    const [stored, format, type] = names.map((name) => gl[name]);
    gl.activeTexture(gl.TEXTURE0 + unit);
    gl.bindTexture(gl.TEXTURE_2D, gl.createTexture());
    gl.texImage2D(gl.TEXTURE_2D, 0, stored, cols, rows, 0, format, type, values);
    this.#sampling(gl.TEXTURE_2D);
  }

  /** Show linear light through a table of view_transforms.js; null: clipped, and encoded as sRGB. */
  setView(table) {
    const gl = this.#gl;
    const { side, bytes, first, stops } = table ?? { side: 1, bytes: new Uint8Array(3), first: 0, stops: 1 };
    gl.activeTexture(gl.TEXTURE4);
    gl.bindTexture(gl.TEXTURE_3D, gl.createTexture());
    gl.texImage3D(gl.TEXTURE_3D, 0, gl.RGB8, side, side, side, 0, gl.RGB, gl.UNSIGNED_BYTE, bytes);
    for (const name of [gl.TEXTURE_MIN_FILTER, gl.TEXTURE_MAG_FILTER]) gl.texParameteri(gl.TEXTURE_3D, name, gl.LINEAR);
    for (const name of [gl.TEXTURE_WRAP_S, gl.TEXTURE_WRAP_T, gl.TEXTURE_WRAP_R]) gl.texParameteri(gl.TEXTURE_3D, name, gl.CLAMP_TO_EDGE);
    gl.uniform3f(this.#places.range, table === null ? 0 : 1, first, stops);
  }

  /**
   * Draw the picture.
   * @param {{shown: Float32Array, compared: Float32Array|null, border: number, gain: number, backdrop: number[], stride?: number, band?: number[], isSame?: boolean}} picture Coefficients
   * [tiles, terms, 3] left and right of the border (0 to 1; null: there is nothing right of it); gain; encoded colour behind the object; of how many pixels
   * in a row and a column one is drawn, all of them at the bottom left of the canvas; rows from and to which is drawn; whether the coefficients are those before.
   */
  draw({ shown, compared, border, gain, backdrop, stride = 1, band = null, isSame = false }) {
    const gl = this.#gl;
    const [width, height] = this.sizeOf(stride);
    gl.viewport(0, 0, width, height);
    const [from, to] = band ?? [0, height];
    gl.enable(gl.SCISSOR_TEST);
    gl.scissor(0, height - to, width, to - from);
    gl.uniform1i(this.#places.stride, stride);
    gl.uniform1f(this.#places.height, height);
    gl.activeTexture(gl.TEXTURE2);
    const { terms, tiles: { count } } = this.relight;
    [shown, compared].forEach((each, side) => each !== null && !isSame && gl.texSubImage2D(gl.TEXTURE_2D, 0, 0, side * count, terms, count, gl.RGB, gl.FLOAT, each));
    gl.uniform1f(this.#places.border, (compared === null ? 1 : border) * this.canvas.width);
    gl.uniform1f(this.#places.gain, gain);
    gl.uniform3f(this.#places.backdrop, ...backdrop);
    const drawing = () => gl.drawArrays(gl.TRIANGLE_STRIP, 0, 4);
    if (band === null) this.timer.during(drawing);
    else drawing(); // a part, after the motion
  }

  /** Return width and height of a picture of one of so many pixels in a row. */
  sizeOf(stride) {
    return [Math.ceil(this.canvas.width / stride), Math.ceil(this.canvas.height / stride)];
  }

  /** Return what says when all is drawn that was asked for so far. */
  fence() {
    const fence = this.#gl.fenceSync(this.#gl.SYNC_GPU_COMMANDS_COMPLETE, 0);
    this.#gl.flush();
    return fence;
  }

  /** Return whether what was asked for before a fence is drawn, and forget the fence then. */
  isPast(fence) {
    const gl = this.#gl;
    if (!gl.isContextLost() && gl.getSyncParameter(fence, gl.SYNC_STATUS) !== gl.SIGNALED) return false;
    gl.deleteSync(fence);
    return true;
  }

  /** Return the bytes [height, width, 4] of what was drawn of one of so many pixels in a row, from the top. */
  pixels(stride = 1) {
    const gl = this.#gl;
    const [width, height] = this.sizeOf(stride);
    const upward = new Uint8Array(4 * width * height);
    gl.readPixels(0, 0, width, height, gl.RGBA, gl.UNSIGNED_BYTE, upward);
    const found = new Uint8ClampedArray(upward.length);
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
