/** Files and folders that a person drops or chooses. */

const IMAGES = /\.(exr|png|jpe?g|tiff?|hdr|npy|webp|bmp|tga|avif)$/i;

/**
 * Return the files of what was dropped: one folder, or one file.
 * @param {DataTransfer} dropped
 * @returns {Promise<{name: string, files: {path: string, file: File}[]}[]>} One entry for each folder or file.
 */
export async function droppedFiles(dropped) {
  const entries = [...dropped.items].map((item) => item.webkitGetAsEntry()).filter((entry) => entry !== null);
  return Promise.all(entries.map(async (entry) => ({ name: entry.name, files: await filesBelow(entry, entry.isDirectory ? null : "") })));
}

/** Return the files of a chosen folder, as `droppedFiles` does. */
export function chosenFolder(list) {
  const files = [...list].map((file) => ({ path: file.webkitRelativePath.split("/").slice(1).join("/"), file })).filter(isWanted);
  return { name: list[0]?.webkitRelativePath.split("/")[0] ?? "", files };
}

/** Return why the files cannot be a capture, in one sentence; null: they can. */
export function faultOfCapture({ name, files }) {
  const paths = files.map(({ path }) => path);
  if (!paths.some((path) => IMAGES.test(path))) return `${name}: the folder has no images: choose the folder that holds capture.json and the images`;
  if (!paths.includes("capture.json")) {
    return `${name}: the folder has no capture.json: relit import writes one for data that is laid out another way (docs/capture.md)`;
  }
  return null;
}

/** Return whether a name is that of an environment map. */
export function isEnvironment(name) {
  return /\.(exr|hdr)$/i.test(name);
}

async function filesBelow(entry, prefix) {
  if (entry.isFile) {
    const file = await new Promise((resolve, reject) => { entry.file(resolve, reject); });
    const found = { path: prefix + entry.name, file };
    return isWanted(found) ? [found] : [];
  }
  const below = prefix === null ? "" : `${prefix}${entry.name}/`;
  const reader = entry.createReader();
  const found = [];
  for (;;) { // readEntries gives at most 100 at a time
    const some = await new Promise((resolve, reject) => { reader.readEntries(resolve, reject); });
    if (some.length === 0) return found;
    for (const each of some) found.push(...(await filesBelow(each, below)));
  }
}

function isWanted({ path }) {
  return path.split("/").every((part) => !part.startsWith(".")); // .relit is a cache, .DS_Store and the like are no images
}
