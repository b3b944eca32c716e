/** How the surface of an asset is drawn: as its materials say, as clay, as wires, or with the colours of its normals. */

import { DoubleSide, MeshNormalMaterial, MeshStandardMaterial } from "three";

const CLAY = 0xb9b0a6;

/** Words of each way. */
export const SURFACES = { asset: "As its materials say", clay: "Clay", wires: "Wires", normals: "Normals" };

const MADE = {
  clay: () => new MeshStandardMaterial({ color: CLAY, roughness: 0.85, side: DoubleSide }),
  wires: () => new MeshStandardMaterial({ color: CLAY, roughness: 1, wireframe: true }),
  normals: () => new MeshNormalMaterial({ side: DoubleSide }),
};

export class Surfaces {
  #own = new Map(); // material of each mesh
  #made = new Map();

  /** @param {import("three").Object3D} object The asset, whose meshes cast shadows and receive them from here on. */
  constructor(object) {
    object.traverse((node) => {
      if (!node.isMesh) return;
      this.#own.set(node, node.material);
      node.castShadow = node.receiveShadow = true;
    });
  }

  /** Draw the surface in a way of SURFACES. */
  show(way) {
    if (way !== "asset" && !this.#made.has(way)) this.#made.set(way, MADE[way]());
    for (const [mesh, material] of this.#own) mesh.material = way === "asset" ? material : this.#made.get(way);
  }

  /** Give everything back that the asset does not have itself. */
  destroy() {
    this.show("asset");
    for (const material of this.#made.values()) material.dispose();
  }
}
