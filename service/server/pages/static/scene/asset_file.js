/** Opens an asset, .usdz or .glb, with the loaders of three.js, and says in words what they could not load. */

import { LoadingManager } from "three";

/** An opened asset. @typedef {{object: import("three").Object3D, triangles: number, points: number, textures: number, problems: string[]}} Asset */

/**
 * Open an asset. Nothing is asked of any server: what is not in the file counts as missing.
 * @param {ArrayBuffer} buffer Of the file.
 * @param {string} name Of the file, whose end says the format.
 * @returns {Promise<Asset>}
 * @throws {Error} The file cannot be opened at all; the message is a sentence that names it.
 */
export async function openAsset(buffer, name) {
  const problems = [];
  const missing = new Set();
  const manager = new LoadingManager();
  manager.setURLModifier((address) => {
    if (/^(blob:|data:)/.test(address)) return address; // parts of the file
    missing.add(address);
    return "data:,";
  });
  manager.onError = (address) => {
    if (address.startsWith("blob:")) problems.push(`${name}: a texture of it cannot be decoded`);
  };
  let object;
  try {
    object = /\.glb$/i.test(name) ? await openGlb(buffer, manager) : await openUsd(buffer, manager);
  } catch (error) {
    throw new Error(`${name} cannot be opened: ${sentence(error)}`);
  }
  problems.push(...[...missing].map((address) => `${name}: ${address} is not in the file, and is left out`));
  const found = { object, ...count(object), problems };
  if (found.triangles === 0 && found.points === 0) {
    problems.push(`${name}: it has nothing that this page can show. The loader of three.js shows the meshes of a USD file, and not its points: see them on the page of the depth.`);
  }
  return found;
}

async function openGlb(buffer, manager) {
  const { GLTFLoader } = await import("three/addons/loaders/GLTFLoader.js");
  return (await new GLTFLoader(manager).parseAsync(buffer, "")).scene;
}

async function openUsd(buffer, manager) {
  const { USDLoader } = await import("three/addons/loaders/USDLoader.js");
  return new Promise((resolve, reject) => { new USDLoader(manager).parse(buffer, "", resolve, reject); });
}

/** Return how much an object holds. */
function count(object) {
  let [triangles, points] = [0, 0];
  const textures = new Set();
  object.traverse((node) => {
    const positions = node.geometry?.getAttribute("position")?.count ?? 0;
    if (node.isMesh) triangles += Math.floor((node.geometry.getIndex()?.count ?? positions) / 3);
    if (node.isPoints) points += positions;
    for (const material of [node.material].flat()) {
      for (const value of Object.values(material ?? {})) if (value?.isTexture && value.image) textures.add(value.image);
    }
  });
  return { triangles, points, textures: textures.size };
}

/** Return what an error says, without the name of the class that says it. */
function sentence(error) {
  return String(error?.message ?? error).replace(/^THREE\.\w+: /, "");
}
