/** Lets a page answer its user between the pieces of long work. */

const MOST_MS = 12; // of work between two breaths
let last = 0;

/** Return at once, or when what waited is done, if the page has worked for a while. */
export async function breath() {
  if (performance.now() - last < MOST_MS) return;
  await new Promise((resolve) => { setTimeout(resolve); });
  last = performance.now();
}

/** Return when what stands on the page is painted. */
export function painted() {
  return new Promise((resolve) => { requestAnimationFrame(() => setTimeout(resolve)); });
}
