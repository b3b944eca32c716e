"""A solve that several workers share: the same to the last bit as that of one worker, whoever does which piece."""

import json
import threading
from pathlib import Path

import numpy as np
import pytest

from service.errors import DivergedError
from service.requests.solve import SolveRequest
from service.sharing import sharing
from service.sharing.sharing import Results, SharedSolve, digest
from service.solve.base import batches
from service.solve.solve import help_solve, solve
from stage.stack import stack
from tests.service.owl import write_small_owl
from tests.service.recording import Recording
from tests.service.sharing.test_several_devices import BAND_BYTES, BATCH_BYTES, CAPTURES, SEARCH_BYTES, distant, extended, with_ball


class Store:
    """A store in memory, which counts who has claimed what."""

    def __init__(self, *, second: str | None = None) -> None:
        """Create a store.

        Args:
            second: a worker that may be slow: no other claims a second piece before this one has claimed its first.
        """
        self.files: dict[str, bytes] = {}
        self.claims: dict[str, str] = {}
        self.gone: set[str] = set()
        self._second, self._second_has_one = second, threading.Event()
        self._lock = threading.Lock()
        if second is None:
            self._second_has_one.set()

    def of(self, worker: str) -> "Part":
        return Part(self, worker)

    def done_by(self, worker: str) -> list[str]:
        with self._lock:
            return [name for name, holder in self.claims.items() if holder == worker]


class Part:
    def __init__(self, store: Store, worker: str) -> None:
        self._store, self._worker = store, worker

    def read(self, name: str) -> bytes | None:
        return self._store.files.get(name)

    def write(self, name: str, content: bytes) -> None:
        self._store.files[name] = content

    def claim(self, name: str) -> bool:
        if self._worker != self._store._second and self._store.done_by(self._worker):
            assert self._store._second_has_one.wait(120)
        with self._store._lock:
            holder = self._store.claims.get(name, self._worker)
            if holder != self._worker and holder not in self._store.gone:
                return False
            self._store.claims[name] = self._worker
        if self._worker == self._store._second:
            self._store._second_has_one.set()
        return True


@pytest.fixture
def small_pieces(monkeypatch):
    monkeypatch.setattr(stack, "BAND_BYTES", BAND_BYTES)
    monkeypatch.setattr(batches, "BATCH_BYTES", BATCH_BYTES)
    monkeypatch.setattr(sharing, "LOOK_S", 0.01)


def shared_solve(request: dict, out: Path, store: Store) -> tuple[Path, Recording]:
    """Solve with a second worker beside, which begins when it is asked to."""
    errors, helpers, progress = [], [], Recording()

    def help_out() -> None:
        try:
            help_solve(SolveRequest(**request, out=out / "two", device="cpu"), Recording(), SharedSolve(store.of("two"), leads=False))
        except BaseException as error:
            errors.append(error)

    def invite(pieces: int) -> None:
        assert pieces > 1
        if not helpers:
            helpers.append(threading.Thread(target=help_out))
            helpers[0].start()

    mine = SharedSolve(store.of("one"), leads=True, invite=invite)
    result = solve(SolveRequest(**request, out=out, device="cpu"), progress, sharing=mine)
    helpers[0].join(60)
    assert not errors and not helpers[0].is_alive()
    assert not (out / "two").exists()
    return result.maps_path, progress


@pytest.mark.long
@pytest.mark.parametrize(("write", "method"), CAPTURES, ids=lambda value: getattr(value, "__name__", value or "-"))
def test_two_workers_find_the_same_to_the_last_bit_as_one(tmp_path, small_pieces, monkeypatch, write, method):
    if write in (extended, with_ball):
        monkeypatch.setattr(batches, "BATCH_BYTES", SEARCH_BYTES)
    request = write(tmp_path / "capture") | ({} if method is None else {"method": method})
    if method in ("lambert", "robust"):  # each worker judges the intensities, which takes longer here than all pieces of these methods
        request["intensities"] = "declared"
    alone = solve(SolveRequest(**request, out=tmp_path / "alone", device="cpu"))
    store = Store(second="two")
    maps, progress = shared_solve(request, tmp_path / "shared", store)
    assert maps.read_bytes() == alone.maps_path.read_bytes()
    assert store.done_by("one") and store.done_by("two")
    assert all(stage.told == sorted(stage.told) and max(stage.told, default=0) <= max(stage.total, 100) for stage in progress.stages)
    reports = [json.loads((folder / "report.json").read_text()) for folder in (tmp_path / "alone", tmp_path / "shared")]
    assert reports[0].get("found") == reports[1].get("found") and reports[0]["pixels"] == reports[1]["pixels"]


@pytest.mark.long
def test_an_object_that_throws_light_on_itself(tmp_path, small_pieces):
    """What follows from the whole object is found by both workers, and has to be the same."""
    request = {"capture": write_small_owl(tmp_path / "owl", 16)}
    alone = solve(SolveRequest(**request, out=tmp_path / "alone", device="cpu"))
    store = Store(second="two")
    maps, _ = shared_solve(request, tmp_path / "shared", store)
    assert maps.read_bytes() == alone.maps_path.read_bytes()
    assert store.done_by("one") and store.done_by("two")


@pytest.mark.long
@pytest.mark.parametrize("method", ["lambert", "svbrdf"])
def test_a_worker_that_begins_again_does_only_what_is_left(tmp_path, small_pieces, method):
    """As one that takes over: finished pieces are read, claims of the dead count no more, and broken files are done again."""
    request = distant(tmp_path / "capture") | {"method": method}
    alone = solve(SolveRequest(**request, out=tmp_path / "alone", device="cpu"))
    store = Store()
    solve(SolveRequest(**request, out=tmp_path / "first", device="cpu"), sharing=SharedSolve(store.of("dead"), leads=True))
    pieces = sorted(name for name in store.files if name.count("/") == 2)
    assert len(pieces) > 3
    missing, cut, flipped = pieces[1], pieces[2], pieces[-1]
    del store.files[missing]
    store.files[cut] = store.files[cut][:-5]
    store.files[flipped] = store.files[flipped][:-1] + bytes([store.files[flipped][-1] ^ 1])
    store.gone.add("dead")
    again = solve(SolveRequest(**request, out=tmp_path / "again", device="cpu"), sharing=SharedSolve(store.of("one"), leads=True))
    assert again.maps_path.read_bytes() == alone.maps_path.read_bytes()
    assert sorted(store.done_by("one")) == sorted(f"{name}.claim" for name in (missing, cut, flipped))


def test_a_piece_of_a_worker_that_is_gone_is_done_by_another():
    """A claimed piece is waited for while the worker that claimed it is alive."""
    store, found, waited = Store(), np.zeros(4), []
    store.claims = {}
    one = SharedSolve(store.of("one"), leads=True)
    one.identify("cpu", "solve")

    def wait() -> None:
        waited.append(1)
        if len(waited) == 3:
            store.gone.add("two")

    class Claimed(Part):
        def claim(self, name: str) -> bool:
            if name.endswith("00001.claim"):
                store.claims.setdefault(name, "two")
            return super().claim(name)

    one._store = Claimed(store, "one")
    one.deal(["cpu"], [0, 1, 2, 3], lambda piece, device: found.__setitem__(piece, piece + 1.0), lambda piece: None, waiting=wait,
             pixels_of=lambda piece: slice(piece, piece + 1), results=Results([found]))
    assert found.tolist() == [1, 2, 3, 4] and len(waited) == 3


@pytest.mark.parametrize("other", ["inputs", "findings"])
def test_a_worker_that_has_something_else_does_nothing(other):
    """Its pieces would be wrong, and so would those that it reads."""
    store = Store()
    one, two = SharedSolve(store.of("one"), leads=True), SharedSolve(store.of("two"), leads=False)
    one.identify("cpu", "a capture", np.arange(3))
    two.identify("cpu", "a capture", np.arange(3) + (other == "inputs"))

    def deal(worker: SharedSolve, follows_from: object) -> None:
        worker.deal(["cpu"], [0, 1], lambda piece, device: None, lambda piece: None, waiting=lambda: None, pixels_of=lambda piece: [piece],
                    results=Results([np.zeros(2)], follows_from))

    deal(one, 1.0)
    before = dict(store.files)
    with pytest.raises(DivergedError, match="not those of the worker that has the job"):
        deal(two, 1.5 if other == "findings" else 1.0)
    assert store.files == before and not store.done_by("two")


def test_a_digest_tells_apart_what_differs_in_one_bit():
    array = np.array([1.0, np.nan], np.float32)
    values = [None, 0, 0.0, "", (), (1, 2), (12,), ((1,), 2), [1, 2], array, array.astype(np.float64), array[::-1], array[:, None],
              np.nextafter(array, 2)]
    assert len({digest(value) for value in values}) == len(values)
    assert digest(array) == digest(array.copy())
    with pytest.raises(TypeError, match="content of a object is not known"):
        digest(object())
