"""What people on a set do by mistake: each is refused or mended before a picture lies under another light than its entry says."""

import socket
import threading

import numpy as np
import pytest

from service.acquisition.acquire import acquire, refuse_to_ask
from service.acquisition.lights.dmx import DmxSwitch
from service.errors import RequestError
from service.play.play import BLACKOUTS
from service.twin.listener import Listener
from stage.rig.rig import read_rig
from tests.scenes.captures import ring, write_image
from tests.scenes.patched_rigs import loopback, write_plan, write_rig_file
from tests.service.acquisition.test_acquire import by_hand, check, controller, request, stage, write_rig  # noqa: F401 (a fixture)
from tests.service.answering import Asked, answering


@pytest.mark.parametrize("late_s", [0.0, 0.06])
def test_two_files_of_one_picture_are_refused(tmp_path, stage, late_s):  # noqa: F811
    """The second one, as raw beside JPEG is, comes after the next release: six frames of seven were of another lamp than they said."""
    rig, ask = by_hand(tmp_path, stage)

    def release() -> None:
        stage.released += 1
        image = 0.2 * sum((stage.scene.images[lamp] for lamp in stage.on), np.zeros_like(stage.scene.images[0])) + 0.001 * stage.released
        for suffix, after_s in (("exr", 0.05), ("tif", 0.05 + late_s)):
            threading.Timer(after_s, write_image, [stage.folder / f"IMG_{stage.released:04d}.{suffix}", image.astype(np.float32)]).start()

    stage.release = release
    with pytest.raises(RequestError, match=r"IMG_000\d\.\w+ and IMG_000\d\.\w+ are two files"):
        acquire(request(tmp_path, stage, rig), ask)


def test_the_folder_of_the_capture_is_not_watched(tmp_path, stage):  # noqa: F811
    rig, ask = by_hand(tmp_path, stage)
    with pytest.raises(RequestError, match="is the folder of --out"):
        acquire(request(tmp_path, stage, rig, out=stage.folder), ask)


def test_a_capture_of_another_origin_is_not_replaced(tmp_path, stage):  # noqa: F811
    rig, ask = by_hand(tmp_path, stage)
    made = tmp_path / "capture" / "capture.json"
    made.parent.mkdir()
    made.write_text("{}")
    with pytest.raises(RequestError, match="another folder to --out"):
        acquire(request(tmp_path, stage, rig), ask)
    assert made.read_text() == "{}" and len(list(made.parent.iterdir())) == 1


def test_a_picture_that_was_deleted_or_damaged_is_taken_again(tmp_path, stage):  # noqa: F811
    rig, ask = by_hand(tmp_path, stage)
    acquire(request(tmp_path, stage, rig), ask)
    (tmp_path / "capture" / "0003_light_002.exr").unlink()
    damaged = tmp_path / "capture" / "0005_light_004.exr"
    damaged.write_bytes(damaged.read_bytes()[:100])
    result = acquire(request(tmp_path, stage, rig), ask)
    assert result.taken == 2 and [fault.shot for fault in result.retaken] == ["0003_light_002", "0005_light_004"] and result.faults == ()
    check(tmp_path / "capture", stage, taken_twice=2)


@pytest.mark.parametrize("sequence", [{"take": "gradients"}, {"take": "olat", "level": 0.5}])
def test_lamps_that_are_only_switched_are_not_dimmed(tmp_path, stage, sequence):  # noqa: F811
    """All seven pictures of gradients were of full light, under entries of gradients."""
    write_plan(tmp_path, sequence)
    rig, ask = by_hand(tmp_path, stage)
    with pytest.raises(RequestError, match="protocol manual only switches"):
        acquire(request(tmp_path, stage, rig), ask)
    with controller(tmp_path, stage) as (rig, url):
        with pytest.raises(RequestError, match=r"controllers\.http\.on has no field"):
            acquire(request(tmp_path, stage, rig), refuse_to_ask)
        dimmed = write_rig(rig, stage, "http", {"http": {"on": {"url": url + "/on/{index}/{level}"}, "off": {"url": url + "/off"}}})
        acquire(request(tmp_path, stage, dimmed, out=tmp_path / "dimmed", retakes=0), refuse_to_ask)


def test_names_of_lamps_are_written_as_codes_into_addresses(tmp_path, stage):  # noqa: F811
    paths = []

    def answer(asked: Asked) -> tuple[int, bytes]:
        paths.append(asked.path)
        return 200, b""

    with answering(answer) as url:
        requests = {"on": {"url": url + "/{name}?a=%20"}, "off": {"url": url + "/off"}}
        rig = write_rig(tmp_path / "rig.json", stage, "http", {"http": requests})
        rig.write_text(rig.read_text().replace('"L0"', '"Süd 1"'))
        with pytest.raises(RequestError, match="no lamp has lit yet"):
            acquire(request(tmp_path, stage, rig, retakes=0), refuse_to_ask)
    assert "/S%C3%BCd%201?a=%20" in paths


@pytest.mark.parametrize("answer", [b"hello\r\n", b"HTTP/1.1 200 OK\r\nTransfer-Encoding: chunked\r\n\r\nzz\r\n"])
def test_a_controller_that_answers_otherwise_than_by_http_is_one_sentence(tmp_path, stage, answer):  # noqa: F811
    with socket.create_server(("127.0.0.1", 0)) as server:
        def serve() -> None:
            asked, _ = server.accept()
            with asked:
                asked.recv(1000)
                asked.sendall(answer)

        threading.Thread(target=serve, daemon=True).start()
        url = f"http://127.0.0.1:{server.getsockname()[1]}/"
        rig = write_rig(tmp_path / "rig.json", stage, "http", {"http": {"on": {"url": url + "{index}"}, "off": {"url": url}}})
        with pytest.raises(RequestError, match=r"controllers\.http: .*no answer") as error:
            acquire(request(tmp_path, stage, rig), refuse_to_ask)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("protocol", ["sacn", "artnet"])
def test_the_levels_of_dmx_are_sent_three_times(tmp_path, protocol):
    """E1.31-2018, section 6.6.2; a lost packet left the lamp of the picture before on for up to 0.8 s."""
    host = loopback()
    path = write_rig_file(tmp_path / "rig.json", ring(2), host=host, protocol=protocol)
    rig = read_rig(path)
    with Listener([(protocol, 1)], host, keep=True) as listener:
        switch = DmxSwitch(path, rig)
        try:
            switch.set(np.ones(len(rig.emitters)))
            threading.Event().wait(0.4)  # less than the 0.8 s of the packets that keep a source alive
            sent = len(listener.kept)
        finally:
            switch.close()
    assert sent == 3 and all(frame.values[protocol, 1][0] == 255 for frame in listener.kept[:sent])
    assert not listener.kept[-1].values[protocol, 1].any() and len(listener.kept) == sent + BLACKOUTS
