"""A video of projected patterns: its frames become a capture, and what compression does to them is said."""

import json

import cv2
import numpy as np
import pytest

from stage.capture.capture import Capture
from stage.formats import exr
from stage.formats.images import read_recorded
from stage.patterns.binary import binary_patterns
from tests.scenes.captures import files_in

WIDTH, ROWS, COLS = 64, 40, 96
U = np.broadcast_to(3.4 + 0.6 * np.arange(COLS), (ROWS, COLS))
HOLD = 3  # frames for which each pattern is shown
PATTERNS = [pattern for pattern in binary_patterns(WIDTH, "column", inverses=True) if pattern.code == "gray"]


def images():
    found = []
    for pattern in PATTERNS:
        light = 0.04 + 0.9 * pattern.level(U, None, WIDTH)
        codes = np.rint(255 * np.clip(np.where(light > 0.0031308, 1.055 * light ** (1 / 2.4) - 0.055, 12.92 * light), 0, 1))
        found.append(np.repeat(codes.astype(np.uint8)[..., None], 3, axis=2))
    return found


def video(path, codec):
    """Two frames before the first pattern; each is shown for three, the first of them in transition."""
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*codec), 30, (COLS, ROWS))
    assert writer.isOpened()
    before = np.zeros((ROWS, COLS, 3), np.uint8)
    for blank in (before, before):
        writer.write(blank)
    for image in images():
        writer.write((image // 2 + before // 2).astype(np.uint8))
        for _ in range(HOLD - 1):
            writer.write(np.ascontiguousarray(image[..., ::-1]))
        before = image
    writer.release()
    return path


def imported(relit, path, folder, frames, *options):
    return relit("import", "gray", path, folder, "--projector", f"{WIDTH}x32", "--sequence", "columns", "--video-frames", frames, *options)


@pytest.mark.parametrize(("codec", "suffix"), [("FFV1", "avi"), ("MJPG", "avi"), ("mp4v", "mp4")])
def test_a_video_goes_to_columns_in_two_commands(relit, tmp_path, codec, suffix):
    path, folder = video(tmp_path / f"scan.{suffix}", codec), tmp_path / "scan"
    last = 2 + HOLD * len(PATTERNS) - 1
    out = imported(relit, path, folder, f"4-{last}:{HOLD}").well()
    manifest = Capture.open(folder).manifest
    assert manifest.color_space == "srgb_texture"
    names = [frame.image for frame in manifest.frames]
    assert names == [f"scan_{4 + HOLD * number:06d}.png" for number in range(len(PATTERNS))]
    if codec == "FFV1":
        assert "lossless" in out and manifest.assumed == ()
        for name, expected in zip(names, images(), strict=True):
            assert np.abs(read_recorded(folder / name).astype(int) - expected).max() <= 2  # through YUV of 8 bits
    else:
        assert "compressed" in out and "frames of a compressed video (" in manifest.assumed[0]
    relit("depth", folder, "--out", tmp_path / "out", "--device", "cpu").well()
    layers, _ = exr.read(tmp_path / "out" / "depth.exr")
    near = layers["mask.Y"] > 0.5
    assert near.mean() > 0.7 and np.abs(layers["projector.U"] - U)[near].max() < 1.5  # stripes of a pixel, sampled at 0.6
    said = json.loads((tmp_path / "out" / "report.json").read_text())["warnings"]
    assert any("compressed video" in warning for warning in said) == (codec != "FFV1")


BAD = {
    "too long": ("scan.avi", "4-900:3", "has 38 frames, 0 to 37, and --video-frames asks for 4 to 900"),
    "backwards": ("scan.avi", "9-4", "--video-frames 9-4: goes backwards or nowhere"),
    "words": ("scan.avi", "all", "all: give first, last and step, such as 12-600:6"),
    "no video": ("text.mp4", "0-3", "text.mp4: is no video that OpenCV decodes"),
    "missing": ("none.mp4", "0-3", "none.mp4"),
    "another count": ("scan.avi", "2-10:3", "has 3 images (scan_000002.png to scan_000008.png) where"),
}


@pytest.mark.parametrize("fault", BAD)
def test_bad_videos(relit, tmp_path, fault):
    name, frames, words = BAD[fault]
    video(tmp_path / "scan.avi", "MJPG")
    (tmp_path / "text.mp4").write_text("no video")
    outcome = imported(relit, tmp_path / name, tmp_path / "scan", frames)
    assert outcome.code == 2 and words in outcome.err
    assert not (tmp_path / "scan" / "capture.json").exists()


def test_a_video_needs_a_folder_and_a_folder_no_frames(relit, tmp_path):
    path = video(tmp_path / "scan.avi", "MJPG")
    before = files_in(tmp_path)
    outcome = relit("import", "gray", path, "--projector", "64x32", "--sequence", "columns")
    assert outcome.code == 2 and "scan.avi: is a video: give a folder for its frames" in outcome.err
    assert "is no video" in imported(relit, tmp_path, tmp_path / "scan", "0-3").refused("--video-frames 0-3: ")
    assert files_in(tmp_path) == before
