"""A solve on several devices of one kind: the same to the last bit as on one, and whole or not at all."""

import json
import threading
import time

import numpy as np
import pytest

from kernels import device as devices
from kernels.errors import DeviceError
from service.requests.solve import SolveRequest
from service.sharing.sharing import deal
from service.solve.base import batches
from service.solve.methods import material
from service.solve.solve import solve
from stage.stack import stack
from tests.reference.gradient import ggx, lambert
from tests.scenes import horn, near_lights
from tests.scenes.captures import make_scene, write_capture
from tests.service.owl import write_small_owl
from tests.service.recording import Recording
from tests.service.solve.methods import test_gradient as gradient
from tests.service.solve.methods import test_reference as reference
from tests.service.waiting import at_once

BAND_BYTES, BATCH_BYTES, SEARCH_BYTES = 1 << 13, 1 << 15, 1 << 19
"""Memory of a band, of a batch, and of a batch for the searches in tables, which keep much for each pixel: small enough that every capture
here has several."""


@pytest.fixture
def pair(device) -> str:
    """One device named twice, which works on two pieces at a time: pieces end in any order, as on two devices."""
    return f"{device},{device}"


@pytest.fixture
def small_pieces(monkeypatch):
    """Bands and batches of a few packs; counts how many were dealt to how many devices."""
    monkeypatch.setattr(stack, "BAND_BYTES", BAND_BYTES)
    monkeypatch.setattr(batches, "BATCH_BYTES", BATCH_BYTES)
    monkeypatch.setattr(devices, "MOST_BATCH_BYTES", BATCH_BYTES)  # a GPU else takes a share of its memory
    dealt = {1: 0, 2: 0}

    def count(names, pieces, work, done):
        def counted(piece):
            dealt[len(names) // devices.pieces_at_once(names[0])] += 1
            done(piece)

        deal(names, pieces, work, counted)

    monkeypatch.setattr(batches, "deal", count)
    return dealt


def distant(folder):
    return {"capture": write_capture(folder, make_scene(size=32, lights=9))}


def near(folder):
    dome = near_lights.dome(16, perspective=True)
    return {"capture": near_lights.write(folder, dome, near_lights.lamps(dome, 16, 1.3))}


def extended(folder):
    return {"capture": horn.write(folder, horn.horn(12), 12), "method": "svbrdf"}


def polarised(folder):
    diffuse = gradient.shaded(lambert) * gradient.SCENE.albedo
    view = np.array([0.0, 0.0, 1.0])
    highlight = gradient.shaded(lambda n, axis, sign: ggx(n, view, axis, sign, alpha=0.04, f0=0.04, nodes=20, turns=30))
    return {"capture": gradient.write(folder, {"parallel": diffuse / 2 + highlight, "cross": diffuse / 2}), "method": "gradient"}


def with_ball(folder):
    ball = reference.write(folder / "ball", *reference.surface(32, 1.0), 0.5, noise=0.01)
    return {"capture": reference.write(folder / "object", *reference.surface(24, 0.7), 0.5, noise=0.01), "method": "reference",
            "reference_ball": ball}


DEALT = [(distant, "lambert"), (distant, "robust"), (distant, "svbrdf"), (near, "robust"), (polarised, None)]
CAPTURES = [*DEALT, (with_ball, None), (near, "svbrdf"), (extended, None)]
"""What is dealt to two devices here; and what two workers share (test_sharing.py), where pieces end in any order too."""


@pytest.mark.long
@pytest.mark.parametrize(("write", "method"), DEALT, ids=lambda value: getattr(value, "__name__", value or "-"))
def test_maps_and_findings_are_the_same_to_the_last_bit(tmp_path, small_pieces, device, pair, write, method):
    request = write(tmp_path / "capture") | ({} if method is None else {"method": method})
    reports, maps = [], []
    for names in (device, pair):
        result = solve(SolveRequest(**request, out=tmp_path / names, device=names))
        maps.append(result.maps_path.read_bytes())
        reports.append(json.loads(result.report_path.read_text()))
    assert maps[0] == maps[1]
    assert reports[0].get("found") == reports[1].get("found") and reports[0]["pixels"] == reports[1]["pixels"]
    assert reports[0]["pixels"]["ok"] > 0
    assert small_pieces[1] == small_pieces[2] > 2  # as many pieces, and more than two devices take at once


@pytest.mark.long
def test_an_object_that_throws_light_on_itself(tmp_path, small_pieces, device, pair):
    """The shadows, the bounces and the shared materials of the owl follow from the whole object, between the passes over it."""
    capture = write_small_owl(tmp_path / "owl", 16)
    one, two = (solve(SolveRequest(capture=capture, out=tmp_path / names, device=names)) for names in (device, pair))
    assert one.maps_path.read_bytes() == two.maps_path.read_bytes()
    found = json.loads(two.report_path.read_text())
    assert found["method"] == "svbrdf" and found["found"]["shared_materials"]
    assert found["device"].count(device) == 2


@pytest.mark.long
def test_an_error_on_one_device_ends_the_solve(tmp_path, small_pieces, pair, monkeypatch):
    calls, whole = [], material.solve_svbrdf

    def fail_on_the_third(*arguments, **options):
        calls.append(1)
        if len(calls) == 3:
            raise MemoryError("no more memory on this device")
        return whole(*arguments, **options)

    monkeypatch.setattr(material, "solve_svbrdf", fail_on_the_third)
    with pytest.raises(MemoryError, match="no more memory"):
        solve(SolveRequest(**distant(tmp_path / "capture"), method="svbrdf", out=tmp_path / "out", device=pair))
    assert len(calls) <= 4  # the other device ends the piece that it has, and takes at most one that was dealt before the error
    assert_nothing_is_left(tmp_path / "out")


class InterruptedProgress(Recording):
    """A progress that is interrupted as Ctrl-C does it: in the thread of the caller, while the devices work."""

    def advance(self, done: int) -> None:
        if self.stages[-1].name == "search":
            raise KeyboardInterrupt


def test_an_interruption_leaves_nothing(tmp_path, small_pieces, pair):
    with pytest.raises(KeyboardInterrupt):
        solve(SolveRequest(**distant(tmp_path / "capture"), method="svbrdf", out=tmp_path / "out", device=pair), InterruptedProgress())
    assert_nothing_is_left(tmp_path / "out")


def assert_nothing_is_left(out) -> None:
    assert not out.exists() or not any(out.iterdir())
    assert not [thread.name for thread in threading.enumerate() if thread.name.startswith("relit-device")]


def test_a_slow_device_gets_fewer_pieces():
    """The next piece goes to the device that is done."""
    both, done = threading.Barrier(2, timeout=30), threading.Event()
    taken = {"slow": [], "fast": []}

    def work(piece: int, device: str) -> None:
        taken[device].append(piece)
        if len(taken[device]) == 1:
            both.wait()  # each has one
            if device == "slow":
                assert done.wait(30)
        if piece == 9:
            done.set()

    told: list[int] = []
    deal(["slow", "fast"], iter(range(10)), work, told.append)
    assert sorted(told) == list(range(10))
    assert len(taken["slow"]) == 1 and len(taken["fast"]) == 9


def test_what_is_raised_waits_for_the_other_device():
    """So nothing works on the image any more when the caller cleans up."""
    begun, ended = threading.Event(), []

    def work(piece: int, device: str) -> None:
        if piece == 1:
            begun.set()
            time.sleep(0.2)
            ended.append(piece)
        else:
            assert begun.wait(30)

    def stop(piece: int) -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        deal(["a", "b"], [0, 1], work, stop)
    assert ended == [1]


@pytest.mark.skipif(len(devices.names()) > 1, reason="this machine has a CUDA device")
def test_all_needs_a_cuda_device():
    with pytest.raises(DeviceError, match="all stands for every CUDA device, and this machine has none"):
        devices.resolve_all("all")


def test_devices_are_named_with_commas_between():
    assert devices.resolve_all("cpu, cpu") == ("cpu", "cpu")
    assert devices.resolve_all() == (devices.resolve(),)
    with pytest.raises(DeviceError, match="device cuda:77 is not on this machine"):
        devices.resolve_all("cpu,cuda:77")


@pytest.mark.parametrize("command", ["demo", "doctor"])
def test_commands_for_one_device_refuse_two(relit, tmp_path, command):
    options = ["--out", tmp_path / "out"] if command == "demo" else []
    assert "device cpu,cpu is not on this machine" in relit.refused(command, *options, "--device", "cpu,cpu")
    assert not (tmp_path / "out").exists()


def test_threads_share_what_is_made_once():
    """A kernel that two devices ask for at the same moment is defined by one of them."""
    made = []

    @devices.once
    def make(name: str) -> object:
        made.append(name)
        return object()

    got = at_once(4, lambda _: make("kernel"))
    assert made == ["kernel"] and all(each is got[0] for each in got)
