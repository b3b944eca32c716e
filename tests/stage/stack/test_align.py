"""Aligned stacks: the images of a moving subject against those of the same subject standing still, and when stacks are kept."""


import numpy as np
import pytest

from stage.capture.capture import Capture
from stage.errors import ImageError, ManifestError
from stage.motion.tracking import tracking_frames
from stage.stack.ingest import open_stack
from tests.scenes.captures import edit_frame, edit_manifest, files_in, write_exr, write_image
from tests.scenes.moving import Subject, write_moving

GLIDING = Subject(size=48, shift_px=(0.43, -0.31))


def aligned(folder, to=None):
    capture = Capture.open(folder)
    return open_stack(capture, tracking=tracking_frames(capture, to=to))


def images(stack) -> np.ndarray:
    """[lights, rows, cols] radiance, red."""
    count, side = stack.light_count, int(np.sqrt(stack.pixel_count))
    values = stack.band(0, stack.shape[2])[0, :count, : stack.pixel_count].astype(np.float64) * stack.scale[:count, None]
    return values.reshape(count, side, side)


def no_reading(stack) -> np.ndarray:
    """[lights, rows, cols] bool."""
    bits = np.unpackbits(stack.saturated(0, stack.shape[2]), axis=0, bitorder="little")
    side = int(np.sqrt(stack.pixel_count))
    return bits[: stack.light_count, : stack.pixel_count].reshape(-1, side, side).astype(bool)


def stacks(folder) -> set[str]:
    return {name for name in files_in(folder / ".relit") if name.endswith(".npy") and "saturated" not in name}


@pytest.mark.parametrize("order", ["TLLLLTLLLLT", "LTLLLTL", "TLLLT"])
def test_frames_become_those_of_the_common_time(tmp_path, order):
    """Also outside the tracking frames: this subject does move on as it did."""
    write_moving(tmp_path / "moving", GLIDING, order)
    write_moving(tmp_path / "still", GLIDING._replace(shift_px=(0, 0)), order)
    truth, inside = images(open_stack(Capture.open(tmp_path / "still"))), GLIDING.mask(0)
    before = np.abs(images(open_stack(Capture.open(tmp_path / "moving"))) - truth)[:, inside] / truth[:, inside]
    found = aligned(tmp_path / "moving")
    after = np.abs(images(found) - truth)[:, inside] / truth[:, inside]
    assert before.mean() > 0.05
    # 0.02 px of flow on waves of 8 to 40 px of 18 % contrast (about 0.1 a pixel), and cubic interpolation of them
    assert np.median(after) < 0.004 and after.mean() < before.mean() / 5
    assert found.frames == open_stack(Capture.open(tmp_path / "moving")).frames


def test_the_statistics_say_how_the_subject_moved(tmp_path):
    write_moving(tmp_path, GLIDING, "LTLLLTLLLT")
    motion = aligned(tmp_path).motion
    assert (motion["reference"], motion["tracking_frames"], motion["extrapolated_frames"]) == ("05.exr", 3, 1)
    assert [(entry["from"], entry["to"], entry["frames"]) for entry in motion["intervals"]] == [
        ("01.exr", "05.exr", 4), ("05.exr", "09.exr", 3)]
    for entry in motion["intervals"]:
        assert entry["displacement_px"]["median"] == pytest.approx(4 * np.hypot(0.43, 0.31), abs=0.05)
        assert entry["displacement_px"]["median"] <= entry["displacement_px"]["max"] < 3.5
        assert 0 <= entry["disagreement_fraction"] < 0.02
    assert 0 <= motion["no_reading_fraction"] < 0.02
    assert aligned(tmp_path).motion == motion  # kept in the cache
    assert open_stack(Capture.open(tmp_path)).motion is None


def test_saturation_moves_with_the_frame_and_takes_its_neighbours(tmp_path):
    subject = Subject(size=48, shift_px=(1.0, 0.0))
    write_moving(tmp_path, subject, "TLLLT", saturation=50.0)
    image = subject.lit(-3, np.array([0.0, 0.0, 1.0]))  # of the first light: 3 px to the left of the reference
    image[20, 21] = 60.0
    write_exr(tmp_path / "01.exr", image)
    found = no_reading(aligned(tmp_path))
    assert found[0, 20, 24] and found[0, 19:22, 23:26].all()
    assert not found[0, 17, 24] and not found[0, 20, 20] and not found[0, 20, 28]  # sixteen pixels, and no more
    assert not found[1:, 8:-8, 8:-8].any()


def test_what_lay_outside_the_image_is_no_reading(tmp_path):
    """A ground that fills the image glides to the right: at the first light its left edge was still outside."""
    subject = Subject(size=48, shift_px=(1.5, 0.0))
    write_moving(tmp_path, subject, "TLLLT", mask=None)
    for time in range(5):
        ground = np.repeat(subject.albedo(time - 4)[..., None], 3, axis=-1)
        write_exr(tmp_path / f"{time:02d}.exr", ground)
    stack = aligned(tmp_path)
    found = no_reading(stack)
    for light, distance in enumerate((4.5, 3.0, 1.5)):
        assert found[light, :, : int(distance)].all()
        assert found[light, 8:-8, 8:-8].mean() < 0.01  # the outermost patches are matched less well
    assert np.isfinite(images(stack)).all()


def test_full_frames_among_gradients_are_aligned_and_measured(tmp_path):
    write_moving(tmp_path, GLIDING, "TLLLTLLLT")
    for index in (1, 2, 3, 5, 6, 7):
        axis, sign = "xyz"[index % 3], 1 if index < 4 else -1
        edit_frame(tmp_path, index, light={"type": "gradient", "axis": axis, "sign": sign})
    found, recorded = aligned(tmp_path), open_stack(Capture.open(tmp_path))
    assert found.light_count == 9
    assert np.array_equal(images(found)[4], images(recorded)[4])  # the reference itself
    inside = GLIDING.mask(0)
    off = np.abs(images(found)[[0, 8]] - images(found)[4])[:, inside]
    assert np.median(off) < 0.002 and np.median(np.abs(images(recorded)[[0, 8]] - images(recorded)[4])[:, inside]) > 0.02


def test_one_aligned_and_one_recorded_stack_are_kept(tmp_path):
    write_moving(tmp_path, GLIDING, "TLLTLLT")
    recorded = open_stack(Capture.open(tmp_path))
    middle = aligned(tmp_path)
    assert middle.key.startswith("aligned-") and not recorded.key.startswith("aligned-")
    assert stacks(tmp_path) == {f"stack-{recorded.key}.npy", f"stack-{middle.key}.npy"}
    first = aligned(tmp_path, to="00.exr")
    assert first.key != middle.key
    assert stacks(tmp_path) == {f"stack-{recorded.key}.npy", f"stack-{first.key}.npy"}
    write_exr(tmp_path / "01.exr", GLIDING.lit(0, np.array([0, 0, 1.0])))
    changed = open_stack(Capture.open(tmp_path))
    assert stacks(tmp_path) == {f"stack-{changed.key}.npy", f"stack-{first.key}.npy"}


def swap(folder):
    """The middle tracking frame a step earlier."""
    edit_manifest(folder, frames=lambda frames: [*frames[:2], frames[3], frames[2], *frames[4:]])


@pytest.mark.parametrize(("change", "recorded_too"), [
    (lambda folder: write_exr(folder / "06.exr", GLIDING.full(1.5)), False),
    (lambda folder: write_image(folder / "mask.png", np.full((48, 48), 255, np.uint8)), False),
    (swap, False),
    (lambda folder: edit_frame(folder, 6, light={"type": "environment", "image": "00.exr"}), False),
    (lambda folder: write_exr(folder / "04.exr", GLIDING.full(0)), True),
], ids=["tracking frame", "mask", "time", "one tracking frame less", "lit frame"])
def test_it_is_rebuilt_when_what_it_depends_on_changes(tmp_path, change, recorded_too):
    write_moving(tmp_path, GLIDING, "TLLTLLT")
    before, recorded = aligned(tmp_path).key, open_stack(Capture.open(tmp_path)).key
    assert aligned(tmp_path).key == before
    change(tmp_path)
    assert aligned(tmp_path).key != before
    assert (open_stack(Capture.open(tmp_path)).key != recorded) == recorded_too


@pytest.mark.parametrize(("dark", "named"), [
    (("00.exr", "03.exr", "06.exr"), "03.exr"), (("06.exr",), "06.exr"), (("03.exr",), "03.exr"),
])
def test_a_dark_tracking_frame_is_named(tmp_path, dark, named):
    write_moving(tmp_path, GLIDING, "TLLTLLT")
    for name in dark:
        write_exr(tmp_path / name, np.zeros((48, 48, 3)))
    with pytest.raises(ImageError, match=rf"{named}: is dark inside the mask"):
        aligned(tmp_path)
    assert not stacks(tmp_path)


def test_a_frame_far_outside_leaves_no_cache(tmp_path):
    write_moving(tmp_path, GLIDING, "TTLLL")
    with pytest.raises(ManifestError, match=r"frames\[3\]: lies more than one tracking interval after"):
        aligned(tmp_path)
    assert not (tmp_path / ".relit").exists()
