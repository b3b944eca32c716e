/** Draws tiles of coefficient planes in WebGL2: a texture array for each tile, with a layer for each image of three planes. */

const VERTEX = `#version 300 es
uniform vec4 box;                 // left, top, right, bottom in clip space
out vec2 place;
void main() {
  place = vec2(gl_VertexID & 1, gl_VertexID >> 1);
  gl_Position = vec4(mix(box.xy, box.zw, place), 0.0, 1.0);
}`;

const fragmentOf = (terms) => `#version 300 es
precision highp float;
precision highp sampler2DArray;
uniform sampler2DArray planes;
uniform mat3 factor[${terms}];    // a column for each of the three planes of an image, which holds 0 to 1
uniform vec3 constant;
in vec2 place;
out vec4 colour;
void main() {
  vec3 sum = constant;
  for (int j = 0; j < ${terms}; j++) sum += factor[j] * texture(planes, vec3(place, j)).rgb;
  colour = vec4(clamp(sum, 0.0, 1.0), 1.0);
}`;

export class PlaneRenderer {
  #gl;
  #places;

  /** @param {HTMLCanvasElement} canvas @param {number} terms Number of images of three planes. */
  constructor(canvas, terms) {
    const gl = canvas.getContext("webgl2", { antialias: false, preserveDrawingBuffer: true });
    if (gl === null) throw new Error("This browser has no WebGL2, which live light needs.");
    this.#gl = gl;
    this.terms = terms;
    const program = gl.createProgram();
    for (const [kind, text] of [[gl.VERTEX_SHADER, VERTEX], [gl.FRAGMENT_SHADER, fragmentOf(terms)]]) {
      const shader = gl.createShader(kind);
      gl.shaderSource(shader, text);
      gl.compileShader(shader);
      gl.attachShader(program, shader);
    }
    gl.linkProgram(program);
    if (!gl.getProgramParameter(program, gl.LINK_STATUS)) throw new Error(`The browser refused the shaders: ${gl.getProgramInfoLog(program)}`);
    gl.useProgram(program);
    this.#places = Object.fromEntries(["box", "factor", "constant"].map((name) => [name, gl.getUniformLocation(program, name)]));
    gl.pixelStorei(gl.UNPACK_COLORSPACE_CONVERSION_WEBGL, gl.NONE);
  }

  /** Return a texture of the images of a tile. */
  texture(images) {
    const gl = this.#gl;
    const texture = gl.createTexture();
    gl.bindTexture(gl.TEXTURE_2D_ARRAY, texture);
    const [{ width, height }] = images;
    gl.texStorage3D(gl.TEXTURE_2D_ARRAY, 1, gl.RGBA8, width, height, images.length);
    images.forEach((image, layer) => gl.texSubImage3D(gl.TEXTURE_2D_ARRAY, 0, 0, 0, layer, width, height, 1, gl.RGBA, gl.UNSIGNED_BYTE, image));
    for (const [name, value] of [[gl.TEXTURE_MIN_FILTER, gl.LINEAR], [gl.TEXTURE_MAG_FILTER, gl.LINEAR], [gl.TEXTURE_WRAP_S, gl.CLAMP_TO_EDGE], [gl.TEXTURE_WRAP_T, gl.CLAMP_TO_EDGE]]) {
      gl.texParameteri(gl.TEXTURE_2D_ARRAY, name, value);
    }
    return texture;
  }

  forget(texture) {
    this.#gl.deleteTexture(texture);
  }

  /**
   * Draw the picture.
   * @param {{texture: WebGLTexture, box: number[]}[]} tiles In the order in which they are drawn; boxes in clip space.
   * @param {Float32Array} factor [terms, 3, 3] @param {number[]} constant
   */
  draw(tiles, factor, constant) {
    const gl = this.#gl;
    gl.viewport(0, 0, gl.drawingBufferWidth, gl.drawingBufferHeight);
    gl.clearColor(0, 0, 0, 1);
    gl.clear(gl.COLOR_BUFFER_BIT);
    gl.uniformMatrix3fv(this.#places.factor, false, factor);
    gl.uniform3fv(this.#places.constant, constant);
    for (const { texture, box } of tiles) {
      gl.bindTexture(gl.TEXTURE_2D_ARRAY, texture);
      gl.uniform4fv(this.#places.box, box);
      gl.drawArrays(gl.TRIANGLE_STRIP, 0, 4);
    }
  }
}
