/** Files and folders that a person drops or chooses. */

/**
 * Return the files of what was dropped: folders, files, or both.
 * @param {DataTransfer} dropped
 * @returns {Promise<{name: string, files: {path: string, file: File}[]}[]>} One entry for each folder and environment, and one for all other
 * files.
 */
export async function droppedFiles(dropped) {
  const entries = [...dropped.items].map((item) => item.webkitGetAsEntry()).filter((entry) => entry !== null);
  const found = await Promise.all(entries.map(async (entry) => ({
    name: entry.name, isFolder: entry.isDirectory, files: await filesBelow(entry, entry.isDirectory ? null : "") })));
  const loose = found.filter((each) => !each.isFolder);
  if (loose.length < 2 || loose.every(({ name }) => isEnvironment(name))) return found;
  return [...found.filter((each) => each.isFolder),
    { name: `${loose[0].name} and ${loose.length - 1} more`, files: loose.flatMap(({ files }) => files) }];
}

/** Return the files of a chosen folder, as `droppedFiles` does. */
export function chosenFolder(list) {
  const files = [...list].map((file) => ({ path: file.webkitRelativePath.split("/").slice(1).join("/"), file })).filter(isWanted);
  return { name: list[0]?.webkitRelativePath.split("/")[0] ?? "", files };
}

/** Return whether files are a capture, a sequence of captures, a scan or a board as they are; else the server is asked what they are. */
export function isCapture({ files }) {
  return files.some(({ path }) => /^([^/]+\/)?capture\.json$|^(sequence|scan|board)\.json$/.test(path));
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
