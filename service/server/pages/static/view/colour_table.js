/** Colour spaces by name, how far declared chromaticities may differ, and other names: written by `make colour-table`. */
export const spaces = {
  lin_rec709_scene: {"toRec709": [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0], "chromaticities": [0.64, 0.33, 0.3, 0.6, 0.15, 0.06, 0.3127, 0.329]},
  lin_ap1_scene: {"toRec709": [1.705051, -0.621792, -0.083259, -0.130256, 1.140805, -0.010548, -0.024003, -0.128969, 1.152972], "chromaticities": [0.713, 0.293, 0.165, 0.83, 0.128, 0.044, 0.32168, 0.33767]},
  lin_ap0_scene: {"toRec709": [2.521686, -1.134131, -0.387555, -0.27648, 1.372719, -0.096239, -0.015378, -0.152975, 1.168353], "chromaticities": [0.7347, 0.2653, 0.0, 1.0, 0.0001, -0.077, 0.32168, 0.33767]},
  lin_rec2020_scene: {"toRec709": [1.660491, -0.587641, -0.07285, -0.12455, 1.1329, -0.008349, -0.018151, -0.100579, 1.11873], "chromaticities": [0.708, 0.292, 0.17, 0.797, 0.131, 0.046, 0.3127, 0.329]},
  lin_p3d65_scene: {"toRec709": [1.22494, -0.22494, 0.0, -0.042057, 1.042057, 0.0, -0.019638, -0.078636, 1.098274], "chromaticities": [0.68, 0.32, 0.265, 0.69, 0.15, 0.06, 0.3127, 0.329]},
  lin_adobergb_scene: {"toRec709": [1.398356, -0.398356, 0.0, 0.0, 1.0, 0.0, 0.0, -0.042929, 1.042929], "chromaticities": null},
};
export const tolerance = 0.002;
export const writtenByOiio = {"acescg": "lin_ap1_scene", "lin_ap1": "lin_ap1_scene", "aces2065-1": "lin_ap0_scene", "lin_ap0": "lin_ap0_scene", "lin_rec2020": "lin_rec2020_scene", "lin_p3d65": "lin_p3d65_scene", "srgb": "srgb_texture", "srgb_texture": "srgb_texture"};
export const undeclared = ["unknown", "data"];
