/** What is shown, kept in the address: the light, the brightness, and the part of the image. */

const NAMES = { light: 2, stops: 1, centre: 2, zoom: 1 };

export class ViewState {
  #asked = null;

  constructor({ width, height }) {
    Object.assign(this, { width, height, light: [0.45, 0.5], stops: 0, centre: [width / 2, height / 2], zoom: 1 }); // zoom 1: the whole fits
    this.read();
  }

  /** Take what the address says; what it does not say, or says wrongly, stays. */
  read() {
    const given = new URLSearchParams(location.hash.slice(1));
    for (const [name, count] of Object.entries(NAMES)) {
      const numbers = (given.get(name) ?? "").split(",").map(parseFloat);
      if (numbers.length === count && numbers.every(Number.isFinite)) this[name] = count === 1 ? numbers[0] : numbers;
    }
    this.#limit();
  }

  /** Change some of it, and the address soon after. */
  set(changes) {
    Object.assign(this, changes);
    this.#limit();
    this.#asked ??= setTimeout(() => {
      this.#asked = null;
      history.replaceState(null, "", `#${this.text()}`);
    }, 250);
  }

  /** Return what the address says. */
  text() {
    return Object.keys(NAMES).map((name) => `${name}=${[this[name]].flat().map((value) => +value.toFixed(3)).join(",")}`).join("&");
  }

  /** Return the unit vector to the light. */
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
    if (reach > 1) this.light = this.light.map((value) => value / reach);
    this.zoom = Math.min(Math.max(this.zoom, 0.5), Math.max(4, Math.max(this.width, this.height) / 50));
    this.stops = Math.min(Math.max(this.stops, -3), 3);
    this.centre = [Math.min(Math.max(this.centre[0], 0), this.width), Math.min(Math.max(this.centre[1], 0), this.height)];
  }
}
