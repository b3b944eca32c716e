"""Fixtures of every test, and which process of a test run runs which files, in which order."""

import atexit
import gc
import re
import signal
from collections.abc import Generator
from pathlib import Path

import pytest

from kernels import device as devices
from tests import emulated_device

for ignored in (signal.SIGINT, signal.SIGHUP):
    if signal.getsignal(ignored) is signal.SIG_IGN:
        # as after `make test &` and under nohup: the run itself goes on ignoring them, but a program inherits only what is ignored and not
        # what is handled, so that programs that tests start take signals as ever
        signal.signal(ignored, lambda *_: None)

LONG_PARTS, EMULATED_PARTS = 20, 6
"""What .ci/run takes the long tests in, and those on the emulated device, one part of each for a commit: all take an hour."""


def pytest_addoption(parser: pytest.Parser) -> None:
    """Let the tests of all devices run as on a machine with a GPU, and a part of the long tests alone."""
    parser.addoption("--device-emulated", action="store_true", help="run tests of devices, and no others, on an emulated cuda:0")
    parser.addoption("--part", type=int, metavar="N", help=f"of the long tests run one of {LONG_PARTS} parts, by files, and of those "
                                                           f"on the emulated device one of {EMULATED_PARTS}, by tests")


def pytest_configure(config: pytest.Config) -> None:
    """Add the emulated device before modules of tests ask for the devices."""
    devices.names()
    if config.getoption("--device-emulated"):
        emulated_device.install()


@pytest.fixture
def device(request: pytest.FixtureRequest) -> str:
    """Each device of this machine: the CPU always, CUDA where present; or the emulated device alone."""
    return request.param


def pytest_generate_tests(metafunc: pytest.Metafunc) -> None:
    """Run a test that takes a device once for each."""
    if "device" in metafunc.fixturenames:
        names = [emulated_device.NAME] if metafunc.config.getoption("--device-emulated") else devices.names()
        metafunc.parametrize("device", names, indirect=True)


LONG_FILE = re.compile(r"^pytestmark = .*pytest\.mark\.long\b", re.MULTILINE)
"""What a file says of which all tests are long."""


def pytest_ignore_collect(collection_path: Path, config: pytest.Config) -> bool | None:
    """Leave out such files where no long test is to run: loading them would take a tenth of the time of collecting tests."""
    if config.option.markexpr != "not long" or collection_path.suffix != ".py":
        return None
    return LONG_FILE.search(collection_path.read_text(encoding="utf-8")) is not None or None


GARBAGE = 100_000
"""Objects after which garbage is searched for: after Python's own 700 it takes half of the time of tests that parse all modules."""


@pytest.hookimpl(wrapper=True, tryfirst=True)
def pytest_collection() -> Generator[None, object, object]:
    """Spare what is loaded for tests the search for garbage: it stays, and looking through it would take a third of the time."""
    gc.disable()
    try:
        return (yield)
    finally:
        gc.enable()
        gc.freeze()
        gc.set_threshold(GARBAGE)
        atexit.register(gc.unfreeze)  # some libraries look for leaks as the interpreter ends; pytest's last search comes before


ONE_SERVER = {"tests/service/server/api": "api", "tests/service/client": "api", "tests/service/server/pages": "pages"}
"""Folders whose tests share a server, by a name for it: it takes processor time as long as it runs, so that one process of the run has all
of them, and ends the server after them."""
OWN_SERVER = ("test_operation_faults.py", "test_projector_page.py", "test_published_page.py", "test_reliability.py", "test_set_page.py",
              "test_tokens.py", "test_traces.py")
"""Files of these folders that start servers of their own, or need none: any process of the run may have them."""
PROGRAMS = ("clients", "server")
"""Folders of tests that start servers, browsers and other programs."""


def together(file: str) -> str:
    """Return what one process of the run has all of: the name of a server whose tests a file has, or the file."""
    return next((name for folder, name in ONE_SERVER.items() if file.startswith(f"{folder}/") and not file.endswith(OWN_SERVER)), file)


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config: pytest.Config, log: object) -> object:
    """Give each process of the run what belongs together; without xdist, as beside Warp and NumPy alone, there is one process."""
    from xdist.scheduler import LoadFileScheduling

    class Together(LoadFileScheduling):
        def _split_scope(self, nodeid: str) -> str:
            return together(super()._split_scope(nodeid))

    return Together(config, log)


@pytest.hookimpl(tryfirst=True)
def pytest_runtest_protocol(item: pytest.Item, nextitem: pytest.Item | None) -> object:
    """End a server with the last test that shares it, as if that ended the run: idle it would take a tenth of the time."""
    group = together(item.nodeid.partition("::")[0])
    if nextitem is None or group not in ONE_SERVER.values() or group == together(nextitem.nodeid.partition("::")[0]):
        return None
    return item.ihook.pytest_runtest_protocol(item=item, nextitem=None)


def is_long(item: pytest.Item) -> bool:
    """Return whether a test is marked `long`."""
    return item.get_closest_marker("long") is not None


def left_out(items: list[pytest.Item], part: int) -> list[pytest.Item]:
    """Return the long tests of all files but every twentieth, beginning with the file of this number modulo twenty."""
    files = sorted({item.path for item in items if is_long(item)})
    chosen = set(files[part % LONG_PARTS::LONG_PARTS])
    return [item for item in items if is_long(item) and item.path not in chosen]


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Begin with the folders whose tests share a server, and spread the files that start other programs evenly over the run.

    Side by side these would wait for each other's processor time. Files with more long tests come first, so that at the end no process of
    the run is left with one of them.
    """
    part = config.getoption("--part")
    if config.getoption("--device-emulated"):
        items[:] = [item for item in items if "device" in getattr(item, "fixturenames", ())]
        items[:] = items if part is None else items[part % EMULATED_PARTS::EMULATED_PARTS]
    elif part is not None:
        without = set(left_out(items, part))
        items[:] = [item for item in items if item not in without]
        config.hook.pytest_deselected(items=list(without))
    groups: dict[str, list[pytest.Item]] = {}
    for item in items:
        groups.setdefault(together(item.nodeid.partition("::")[0]), []).append(item)
    in_order = sorted(groups, key=lambda group: -sum(map(is_long, groups[group])))
    servers = [group for group in dict.fromkeys(ONE_SERVER.values()) if group in groups]
    starts = [group for group in in_order if group not in servers and set(PROGRAMS) & set(Path(group).parts)]
    others = [group for group in in_order if group not in servers and group not in starts]
    place = {group: (number + 0.5) / len(some) for some in (starts, others) for number, group in enumerate(some)}
    items[:] = [item for group in servers + sorted(place, key=lambda group: place[group]) for item in groups[group]]
