/** What an asset is lit with: a neutral room, an environment map, or one light of the rig. */

import { DataTexture, DirectionalLight, EquirectangularReflectionMapping, FloatType, LinearFilter, LinearSRGBColorSpace, MathUtils, PMREMGenerator, RGBAFormat } from "three";

const LARGEST_COLS = 1024; // of a map: three.js makes cubes of a quarter of it
const QUARTER = 4; // three.js has +x in the middle of a map, Relit +z: a quarter of the width
const KEPT = 2; // filtered maps: the first, which is the room, and the one that was opened last
const SHADOW_PX = 2048; // of the shadow map in each direction
const SHADOW_BIAS = 0.01; // in radii of the object, along the normal: half a pixel of the map at 85° from the light
const FAR = 3; // radii from the middle of the object to the light that casts shadows
const ROOM = { cols: 64, rows: 32, sky: 1.35, floor: 0.45, lamp: 5, lampAt: [0.45, 0.6, 0.66], lampCosine: 0.94 };

/** Return a neutral room as an environment map: light from above, and a lamp before the object, above and to the right. */
export function neutralRoom() {
  const { rows, cols } = ROOM;
  const pixels = new Float32Array(3 * rows * cols);
  for (let row = 0; row < rows; row += 1) {
    const polar = (Math.PI * (row + 0.5)) / rows;
    for (let col = 0; col < cols; col += 1) {
      const azimuth = (2 * Math.PI * (col + 0.5)) / cols;
      const direction = [Math.sin(azimuth) * Math.sin(polar), Math.cos(polar), -Math.cos(azimuth) * Math.sin(polar)];
      const lamp = direction.reduce((sum, value, axis) => sum + value * ROOM.lampAt[axis], 0) > ROOM.lampCosine ? ROOM.lamp : 0;
      pixels.fill(ROOM.floor + ((ROOM.sky - ROOM.floor) * (1 + direction[1])) / 2 + lamp, 3 * (row * cols + col), 3 * (row * cols + col) + 3);
    }
  }
  return { rows, cols, pixels };
}

/**
 * Return the exposure in stops that shows a white surface as white: one that faces light of this irradiance.
 * @param {number} irradiance The largest of its channels.
 */
export function stopsFor(irradiance) {
  return irradiance > 0 ? Math.log2(Math.PI / irradiance) : 0;
}

/** Return the irradiance of a map on a surface that faces its light, taken as one distant light before an even rest: the largest of the channels. */
export function facingIrradiance({ rows, cols, pixels }) {
  const sums = new Float64Array(12); // over the sphere, of the radiance and of its x, y and z parts: three channels each
  for (let row = 0; row < rows; row += 1) {
    const polar = (Math.PI * (row + 0.5)) / rows;
    const [sine, cosine] = [Math.sin(polar), Math.cos(polar)];
    for (let col = 0; col < cols; col += 1) {
      const azimuth = (2 * Math.PI * (col + 0.5)) / cols;
      const [x, z] = [Math.sin(azimuth) * sine, -Math.cos(azimuth) * sine];
      for (let c = 0; c < 3; c += 1) {
        const light = pixels[3 * (row * cols + col) + c] * sine;
        sums[c] += light;
        sums[3 + c] += light * x;
        sums[6 + c] += light * cosine;
        sums[9 + c] += light * z;
      }
    }
  }
  // a distant light of irradiance E has the sum E and a vector of length E, an even radiance L the sum 4 π L and none: E and π L come out
  const facing = [0, 1, 2].map((c) => sums[c] / 4 + 0.75 * Math.hypot(sums[3 + c], sums[6 + c], sums[9 + c]));
  return (Math.max(...facing) * 2 * Math.PI ** 2) / rows / cols;
}

/**
 * Return a map as a texture of three.js: the bottom row first, and +x in the middle.
 * @param {{rows: number, cols: number, pixels: Float32Array}} map Radiance [rows, cols, 3], from the top, +z in the middle.
 */
function latLongTexture(map) {
  const factor = Math.max(1, Math.ceil(map.cols / LARGEST_COLS));
  const [rows, cols] = [Math.floor(map.rows / factor), Math.floor(map.cols / factor)];
  const values = new Float32Array(4 * rows * cols).fill(1);
  for (let row = 0; row < rows; row += 1) {
    for (let col = 0; col < cols; col += 1) {
      const to = 4 * ((rows - 1 - row) * cols + ((col + Math.floor(cols / QUARTER)) % cols));
      for (let c = 0; c < 3; c += 1) {
        let sum = 0;
        for (let down = 0; down < factor; down += 1) {
          for (let across = 0; across < factor; across += 1) sum += map.pixels[3 * ((row * factor + down) * map.cols + col * factor + across) + c];
        }
        values[to + c] = sum / factor ** 2;
      }
    }
  }
  const texture = new DataTexture(values, cols, rows, RGBAFormat, FloatType);
  texture.mapping = EquirectangularReflectionMapping;
  texture.colorSpace = LinearSRGBColorSpace;
  texture.minFilter = texture.magFilter = LinearFilter;
  texture.needsUpdate = true;
  return texture;
}

/** Lights a scene in one way at a time. */
export class Lighting {
  #scene;
  #renderer;
  #filtered = new Map(); // of maps, for all roughnesses
  #light = new DirectionalLight();
  #center;
  #radius;

  /**
   * @param {import("three").Scene} scene @param {import("three").WebGLRenderer} renderer
   * @param {import("three").Vector3} center Of the object that casts shadows. @param {number} radius Of it.
   */
  constructor(scene, renderer, center, radius) {
    this.#scene = scene;
    this.#renderer = renderer;
    this.#center = center;
    this.#radius = radius;
    renderer.shadowMap.enabled = true;
    const { shadow } = this.#light;
    shadow.mapSize.set(SHADOW_PX, SHADOW_PX);
    shadow.normalBias = SHADOW_BIAS * radius;
    Object.assign(shadow.camera, { left: -radius, right: radius, top: radius, bottom: -radius, near: (FAR - 1.5) * radius, far: (FAR + 1.5) * radius });
  }

  /** Light by an environment map, as `latLongTexture` takes it; a map that is used again is not filtered again. */
  byMap(map) {
    this.#clear();
    const filtered = this.#filtered.get(map) ?? this.#filter(map);
    this.#filtered.set(map, filtered);
    if (this.#filtered.size > KEPT) this.#forget([...this.#filtered.keys()][1]);
    this.#scene.environment = filtered.texture;
  }

  #filter(map) {
    const texture = latLongTexture(map);
    const generator = new PMREMGenerator(this.#renderer);
    const filtered = generator.fromEquirectangular(texture);
    generator.dispose();
    texture.dispose();
    return filtered;
  }

  #forget(map) {
    this.#filtered.get(map).dispose();
    this.#filtered.delete(map);
  }

  /** Turn the environment about +y: what shines from +z then shines from +x after 90 degrees. */
  turn(degrees) {
    this.#scene.environmentRotation.set(0, MathUtils.degToRad(degrees), 0);
  }

  /**
   * Light by one distant light.
   * @param {number[]} direction From the object to the light.
   * @param {number[]} irradiance Red, green and blue, on a surface that faces it.
   * @param {boolean} casts Whether the object casts shadows on itself.
   */
  byLight(direction, irradiance, casts) {
    this.#clear();
    const largest = Math.max(...irradiance, Number.MIN_VALUE);
    this.#light.color.setRGB(...irradiance.map((value) => value / largest), LinearSRGBColorSpace);
    this.#light.intensity = largest;
    this.#light.position.set(...direction).multiplyScalar(FAR * this.#radius).add(this.#center);
    this.#light.target.position.copy(this.#center);
    this.#light.castShadow = casts;
    this.#scene.add(this.#light, this.#light.target);
  }

  /** Give the filtered maps back, as after the graphics processor has lost them; nothing lights the scene then. */
  forgetMaps() {
    this.#clear();
    for (const map of [...this.#filtered.keys()]) this.#forget(map);
  }

  /** Give everything back. */
  destroy() {
    this.forgetMaps();
    this.#light.dispose();
  }

  #clear() {
    this.#scene.environment = null;
    this.#light.removeFromParent();
    this.#light.target.removeFromParent();
  }
}
