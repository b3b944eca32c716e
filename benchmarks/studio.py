"""Charts that are found and corrected, and pictures that OpenLIME shows, against what the renderer and the photographs say."""

import tempfile
from pathlib import Path

import numpy as np

from service.calibrate.chart import calibrate_chart
from service.publish.publish import publish
from service.requests.chart import ChartRequest
from service.requests.publish import PublishRequest
from tests.scenes.chart import CAMERA, picture, poses, reflectances, shoot
from tests.service.publish.published import dome, levels_rms, sample, shown

OWL = Path(__file__).parents[1] / "samples" / "owl"
LIGHTS = {"daylight": (1.0, 1.0, 1.0), "tungsten": (1.3, 1.0, 0.45), "an overcast sky": (0.75, 1.0, 1.35)}
POSES, NOISE, EXPOSURE = 20, 0.01, 0.5


def chart_rows() -> list[str]:
    """Measure a rendered ColorChecker in every pose under every light."""
    lines = ["| light | found | corners, farthest | mean CIEDE2000 before | after, worst pose |", "|---|---|---|---|---|"]
    for light, white in LIGHTS.items():
        corners, before, after = [], [], []
        for number, pose in enumerate(poses(POSES)):
            seen = picture(EXPOSURE * np.array(white) * (reflectances() @ CAMERA.T), pose, seed=number)
            noise = NOISE * np.random.default_rng(number).normal(size=seen.pixels.shape)
            with tempfile.TemporaryDirectory() as name:
                found = calibrate_chart(ChartRequest(capture=shoot(Path(name), [np.maximum(seen.pixels + noise, 0)])))
            corners.append(np.linalg.norm(found.corners - seen.corners, axis=1).max())
            before.append(np.nanmean(found.kinds[0].colors.before))
            after.append(np.nanmean(found.kinds[0].colors.after))
        lines.append(f"| {light} | {len(corners)} of {POSES} | {max(corners):.2f} pixels | {np.mean(before):.1f} | {max(after):.2f} |")
    return lines


def openlime_rows() -> list[str]:
    """Measure what the sums of OpenLIME's shader are from the components before bytes and JPEG files."""
    lines = ["| capture | lights | files | all together | farthest light |", "|---|---|---|---|---|"]
    with tempfile.TemporaryDirectory() as name:
        made = Path(name) / "dome"
        for label, capture, (lights, truth) in (("sample owl", OWL, sample(OWL)), ("the tests' dome", made, dome(made))):
            folder = Path(name) / "published"
            size = publish(PublishRequest(capture=capture, out=folder, kind="openlime", cache=Path(name) / "cache")).size
            found = levels_rms(np.rint(255 * shown(folder, lights)) / 255, truth)
            lines.append(f"| {label} | {len(lights)} | {size / 1e6:.2f} MB | {np.sqrt(np.mean(found**2)):.2f} | {found.max():.2f} |")
    return lines


def studio_rows() -> list[str]:
    """Return the tables."""
    return [f"A rendered ColorChecker of 640 x 480 pixels in {POSES} poses up to 40°, 1 % noise, exposure {EXPOSURE} (bars: all found, "
            "2 pixels, 1.0):", "", *chart_rows(), "",
            "`relit publish --as openlime`: RMS of what the sums of OpenLIME's shader give on a display of bytes, in 255 levels, from the "
            "components before bytes and JPEG, over whole pictures (bar: 2):", "", *openlime_rows()]
