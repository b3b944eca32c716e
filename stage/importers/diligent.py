"""Import of the DiLiGenT benchmark: filenames.txt, light_directions.txt, light_intensities.txt, mask.png, 16-bit PNG.

Source: Shi et al., "A Benchmark Dataset and Evaluation for Non-Lambertian and Uncalibrated Photometric Stereo", TPAMI 2019.
Its camera frame is that of relit (x right, y up, z to the camera). Images are linear; light intensities become irradiances, whose common
scale is unknown.
"""

from pathlib import Path

from stage.errors import ManifestError
from stage.formats import images
from stage.importers.camera_options import mask_beside
from stage.importers.layout import doubled_lights, image_resolution, read_lines, write_capture
from stage.importers.light_table import read_light_table, read_strengths


def import_folder(source: Path, destination: Path) -> Path:
    """Write a capture.json for an object of the DiLiGenT benchmark."""
    names = [line for _, line in read_lines(source / "filenames.txt")]
    directions = read_light_table(source / "light_directions.txt", run="rows").vectors
    intensities = read_strengths(source / "light_intensities.txt")
    for name, table in (("light_directions.txt", directions), ("light_intensities.txt", intensities)):
        if len(table) != len(names):
            raise ManifestError(f"{source / name}: has {len(table)} rows, filenames.txt names {len(names)} images")
    resolution = image_resolution(source / names[0])
    linear = [] if not images.read_header(source / names[0]).eight_bits else [
        f"color_space: {names[0]} has 8 bits and was taken as linear, as the 16 bits of the benchmark are: JPEG images and most "
        "others of 8 bits are srgb_texture"]
    return write_capture({
        "name": source.resolve().name,
        "color_space": "lin_rec709_scene",
        "camera": {"projection": "orthographic", "resolution": resolution},
        "mask": mask_beside(source, names),
        "irradiance_scale": "relative",
        "assumed": [*linear, *doubled_lights(names, directions.tolist(), source / "light_directions.txt")],
        "frames": [
            {"image": name, "light": {"type": "distant", "direction": list(direction), "irradiance": list(intensity)}}
            for name, direction, intensity in zip(names, directions.tolist(), intensities.tolist(), strict=True)
        ],
    }, source / "filenames.txt", destination)
