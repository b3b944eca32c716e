/** What is shown, kept in the address: the light, the brightness, and the part of the image. */

import { Address } from "./address.js";

const NAMES = { light: 2, stops: 1, centre: 2, zoom: 1 };

export class ViewState {
  #address;

  /**
   * @param {{width: number, height: number}} image Its pixels.
   * @param {Object<string, number>} [names] What is kept, as Address takes it.
   * @param {number[]} [light] At first: x and y of a direction towards the camera, or all three parts of any direction.
   */
  constructor({ width, height }, names = NAMES, light = [0.45, 0.5]) {
    Object.assign(this, { width, height, light, stops: 0, centre: [width / 2, height / 2], zoom: 1 }); // zoom 1: the whole fits
    this.#address = new Address(names);
    this.read();
  }

  /** Take what the address says; what it does not say, or says wrongly, stays. */
  read() {
    this.#address.read(this);
    this.#limit();
  }

  /** Change some of it, and the address soon after. */
  set(changes) {
    Object.assign(this, changes);
    this.#limit();
    this.#address.write(this);
  }

  /** Return what the address says. */
  text() {
    return this.#address.text(this);
  }

  /** Return the unit vector to the light, of which x and y are kept. */
  direction() {
    const [x, y] = this.light;
    return [x, y, Math.sqrt(Math.max(0, 1 - x * x - y * y))];
  }

  /** Return CSS pixels per pixel of the image in a box of this size. */
  scale(across, down) {
    return this.zoom * Math.min(across / this.width, down / this.height);
  }

  #limit() {
    const reach = Math.hypot(...this.light);
    if (reach > 1 || this.light.length > 2) this.light = this.light.map((value) => value / (reach || 1));
    this.zoom = Math.min(Math.max(this.zoom, 0.5), Math.max(4, Math.max(this.width, this.height) / 50));
    this.stops = Math.min(Math.max(this.stops, -3), 3);
    this.centre = [Math.min(Math.max(this.centre[0], 0), this.width), Math.min(Math.max(this.centre[1], 0), this.height)];
  }
}
