/** Values that the address keeps after its #, so that a link shows what its sender saw, and Back returns to it. */

const SOON_MS = 250; // browsers refuse addresses that change faster for long

const pending = new Map(); // what is to be written, and when, by its address

// Back, Forward and links: what was to be written is of the page as it was left, and the address is another's
addEventListener("popstate", () => {
  for (const { timer } of pending.values()) clearTimeout(timer);
  pending.clear();
});

/** Write at once what is to be written soon, as before the address becomes that of something else. */
export function writeNow() {
  for (const { write } of pending.values()) write();
}

/** Return the names and texts that the address has, in their order. */
function entries() {
  return [...new URLSearchParams(location.hash.slice(1))];
}

export class Address {
  #names;
  #source = {};

  /** @param {Object<string, number>} names Of the values, each with the count of its numbers; 0: it is a word. Others in the address stay as they are. */
  constructor(names) {
    this.#names = names;
  }

  /** Put what the address says into an object; what it does not say, or says wrongly, stays. */
  read(target) {
    const given = new Map(entries());
    for (const [name, count] of Object.entries(this.#names)) {
      if (count === 0) {
        if (given.has(name)) target[name] = given.get(name);
        continue;
      }
      const numbers = (given.get(name) ?? "").split(",").map(parseFloat);
      if (numbers.length === count && numbers.every(Number.isFinite)) target[name] = count === 1 ? numbers[0] : numbers;
    }
  }

  /** Change the address to what an object says, soon. */
  write(source) {
    this.#source = source;
    if (pending.has(this)) return;
    const write = () => {
      clearTimeout(timer);
      pending.delete(this);
      const others = entries().filter(([name]) => !(name in this.#names)).map(([name, value]) => `${name}=${encoded(value)}`);
      history.replaceState(null, "", `#${[this.text(this.#source), ...others].filter((part) => part !== "").join("&")}`);
    };
    const timer = setTimeout(write, SOON_MS);
    pending.set(this, { write, timer });
  }

  /** Return what the address says of an object; what it lacks is left out. */
  text(source) {
    const said = Object.keys(this.#names).filter((name) => source[name] !== undefined);
    return said.map((name) => `${name}=${[source[name]].flat().map((value) => encoded(typeof value === "number" ? +value.toFixed(3) : value)).join(",")}`).join("&");
  }
}

function encoded(value) {
  return encodeURIComponent(value).replaceAll("%2C", ",");
}
