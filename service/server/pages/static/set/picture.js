/** Pictures of the set, which are asked for with the key of this tab. */

import { attempt, send } from "../api.js";

/** Show the picture at a path in an image, unless another one is asked for meanwhile; `data-shown` is the path when it is there. */
export function showPicture(image, path) {
  image.dataset.asked = path;
  return attempt(async () => {
    const address = URL.createObjectURL(await (await send(path)).blob());
    if (image.dataset.asked !== path) {
      URL.revokeObjectURL(address);
      return;
    }
    const before = image.src;
    image.src = address;
    await image.decode();
    if (before.startsWith("blob:")) URL.revokeObjectURL(before);
    image.dataset.shown = path;
  });
}
