/** How the surface of an asset is drawn: as its materials say, as clay, as wires, with the colours of its normals, or with one of its maps and no light. */

import { DoubleSide, MeshBasicMaterial, MeshNormalMaterial, MeshStandardMaterial } from "three";

const CLAY = 0xb9b0a6;

/** Words of each way. */
export const SURFACES = { asset: "Its materials", clay: "Clay", wires: "Wires", normals: "Normals", albedo: "Albedo", roughness: "Roughness", metalness: "Metalness" };

const MADE = {
  clay: () => new MeshStandardMaterial({ color: CLAY, roughness: 0.85, side: DoubleSide }),
  wires: () => new MeshStandardMaterial({ color: CLAY, roughness: 1, wireframe: true }),
  normals: () => new MeshNormalMaterial({ side: DoubleSide }),
};

const MAPS = { albedo: ["map", "color"], roughness: ["roughnessMap", "roughness"], metalness: ["metalnessMap", "metalness"] }; // and the factor beside each
const CHANNEL = { roughness: "g", metalness: "b" }; // as glTF packs them; a grey map has its value in all

/** Return a material that shows one map of another, and no light. */
function mapMaterial(way, own) {
  const [map, factor] = MAPS[way];
  const made = new MeshBasicMaterial({ map: own[map], side: DoubleSide, toneMapped: false });
  if (way === "albedo") made.color.copy(own.color);
  else {
    made.color.setScalar(own[factor]);
    made.onBeforeCompile = (shader) => {
      shader.fragmentShader = shader.fragmentShader.replace("#include <map_fragment>", `#ifdef USE_MAP\n diffuseColor.rgb *= texture2D(map, vMapUv).${CHANNEL[way]};\n#endif`);
    };
    made.customProgramCacheKey = () => way;
  }
  return made;
}

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

  /** Return whether the asset can be drawn in a way: its materials have that map. */
  has(way) {
    return !(way in MAPS) || [...this.#own.values()].every((material) => material[MAPS[way][0]]?.isTexture);
  }

  /** Draw the surface in a way of SURFACES. */
  show(way) {
    for (const [mesh, material] of this.#own) {
      const key = way in MAPS ? `${way} ${material.uuid}` : way;
      if (way !== "asset" && !this.#made.has(key)) this.#made.set(key, way in MAPS ? mapMaterial(way, material) : MADE[way]());
      mesh.material = way === "asset" ? material : this.#made.get(key);
    }
  }

  /** Give everything back that the asset does not have itself. */
  destroy() {
    this.show("asset");
    for (const material of this.#made.values()) material.dispose();
  }
}
