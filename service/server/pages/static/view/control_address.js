/** Controls of a page that the address keeps: what differs from how the page opens. */

import { Address } from "../publish/address.js";

/** Controls by the name that their value has in the address. */
export class ControlAddress {
  #controls;
  #address;
  #first;

  /** @param {Object<string, HTMLInputElement|HTMLSelectElement>} controls As the page opens. */
  constructor(controls) {
    this.#controls = controls;
    this.#first = this.#values();
    this.#address = new Address(Object.fromEntries(Object.keys(controls).map((name) => [name, 0])));
  }

  /** Set the controls to what the address says, and return the names of those that it names; a value that a control does not take leaves it as it is. */
  read() {
    const given = {};
    this.#address.read(given);
    for (const [name, value] of Object.entries(given)) {
      const control = this.#controls[name];
      const before = control.value;
      if (control.type === "checkbox") control.checked = value === "1";
      else control.value = value;
      if (control.value === "" && value !== "") control.value = before;
    }
    return Object.keys(given);
  }

  /** Let the address say what the controls are. */
  write() {
    const now = this.#values();
    this.#address.write(Object.fromEntries(Object.entries(now).filter(([name, value]) => value !== this.#first[name])));
  }

  #values() {
    return Object.fromEntries(Object.entries(this.#controls).map(([name, control]) => [name, control.type === "checkbox" ? String(Number(control.checked)) : control.value]));
  }
}
