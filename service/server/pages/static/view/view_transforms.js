/** View transforms: how scene-linear light becomes the colours of a screen. */

import { fetched } from "../api.js";

const CLIPPED = "srgb";
/** View transforms by name, in words. */
export const VIEW_TRANSFORMS = { [CLIPPED]: "sRGB, clipped", aces: "ACES 2.0, 100 nits" };
const TABLE = { side: 33, first: -12, stops: 19 }; // as docs/tools/view_table.py writes it

/** Return the table of a view transform, as BasisRenderer takes it; null: it needs none. */
export async function viewTable(name) {
  if (name === CLIPPED) return null;
  const bytes = await fetched(new URL(`${name}.bin`, import.meta.url).pathname, (answer) => answer.arrayBuffer());
  return { ...TABLE, bytes: new Uint8Array(bytes) };
}
