"""Work in pieces that are kept: done once, done again where it was damaged, and never taken for that of another run."""

import shutil
from collections import Counter

import pytest

from service.errors import DivergedError
from service.requests.register import RegisterRequest
from service.scans import kept_scans
from service.scans.pieces import FolderPieces, SharedPieces
from service.scans.register import register_scans
from stage.sets.scan_set import read_scan_set
from tests.scenes.turntable import figure
from tests.service.scans.test_register import views, write

NAMES = ["one", "two", "three"]


class Made:
    """Counts what is made."""

    def __init__(self) -> None:
        self.counts: Counter[str] = Counter()

    def __call__(self, name: str) -> bytes:
        self.counts[name] += 1
        return name.encode()


def run(folder, made: Made, *, of: str = "inputs", follows_from: object = 1, leads: bool = True) -> list[bytes]:
    pieces = SharedPieces(FolderPieces(folder), leads=leads)
    pieces.identify(of)
    content = pieces.do("phase", NAMES, made, follows_from=follows_from, threads=2)
    return [content(name) for name in NAMES]


def test_pieces_are_made_once_and_anew_for_what_differs(tmp_path):
    made = Made()
    assert run(tmp_path, made) == run(tmp_path, made) == [b"one", b"two", b"three"]
    assert set(made.counts.values()) == {1}
    run(tmp_path, made, of="other inputs")
    run(tmp_path, made, follows_from=2)
    assert set(made.counts.values()) == {3}


def test_a_damaged_piece_is_made_again(tmp_path):
    made = Made()
    run(tmp_path, made)
    file, = tmp_path.rglob("two")
    file.write_bytes(file.read_bytes()[:-1] + b"?")
    assert run(tmp_path, made) == [b"one", b"two", b"three"]
    assert made.counts == {"one": 1, "two": 2, "three": 1}


def test_who_helps_with_something_else_is_stopped(tmp_path):
    run(tmp_path, Made())
    with pytest.raises(DivergedError):
        run(tmp_path, Made(), follows_from=2, leads=False)


def test_an_exception_of_the_progress_ends_the_work(tmp_path):
    def cancelled(done: int) -> None:
        raise KeyboardInterrupt

    made = Made()
    pieces = SharedPieces(FolderPieces(tmp_path))
    with pytest.raises(KeyboardInterrupt):
        pieces.do("phase", NAMES, made, advance=cancelled)
    assert not made.counts


@pytest.mark.long
def test_a_registration_that_was_interrupted_goes_on(tmp_path, monkeypatch):
    """Half of the pairs are there, and no scan is prepared again."""
    folder = write(tmp_path / "set", views(figure, 0, 40, 80))
    request = RegisterRequest(scan_set=folder, out=tmp_path / "out", cache=tmp_path / "cache", threads=1)
    _, first = read_scan_set(register_scans(request).scan_set_path)
    lost = sorted((tmp_path / "cache").rglob("*-pairs-*/00000-*"))
    for path in lost:
        path.unlink()
    shutil.rmtree(tmp_path / "out")
    prepared, paired, register_pair = [], [], kept_scans.register_pair
    monkeypatch.setattr(kept_scans, "prepare", lambda *given, **options: prepared.append(given))
    monkeypatch.setattr(kept_scans, "register_pair", lambda task, *given, **options: paired.append(task) or register_pair(
        task, *given, **options))
    _, second = read_scan_set(register_scans(request).scan_set_path)
    assert second == first and not prepared and {(task.a, task.b) for task in paired} == {(0, 1), (0, 2)}
