"""What tests share: where the reference numbers and the real scans lie, if they lie beside the project."""

import compileall
import copy
import functools
import gc
import inspect
import itertools
import json
import os
import re
import signal
from collections import OrderedDict
from collections.abc import Callable, Iterator
from pathlib import Path

import jaxtyping
import numpy as np
import pytest
import torch
from hypothesis import settings

import lidargrit
from browser import CHROMIUM, Browser
from lidargrit.core import reporting

SHARED = Path(os.environ.get("LIDARGRIT_SHARED", Path(__file__).resolve().parents[2] / "shared"))

# How long an example takes says nothing: other tests run beside it.
settings.register_profile("unhurried", deadline=None)
settings.load_profile("unhurried")
# Commands that tests kill, or let run out of disk, would leave cut bytecode behind for all that follow: they find it
# made, which spares each of the many child processes half a second, and write none.
compileall.compile_dir(Path(lidargrit.__file__).parent, quiet=2)
os.environ["PYTHONDONTWRITEBYTECODE"] = "1"
gc.disable()  # a quarter of the time to collect tests was spent on looking for circles among things that stay
torch.set_num_threads(1)  # two threads while another process runs can be many times slower

with_shapes_checked = jaxtyping.jaxtyped
CHECKED_CALLS = 2  # of each function in each test
STREETS_KEPT = 50  # of 3 MB each
test_number = itertools.count()
running_test = next(test_number)


def checked(function: type | Callable, typechecker: Callable) -> type | Callable:
    """Check a class, or the first calls in each test of a function that takes or returns tensors.

    Of all other functions pyright knows the types. A check costs tens of microseconds: on all functions it was 40 % of
    what the tests computed, on every call still half in tests of pixel decoders, which call some of them 10,000 times.
    """
    if inspect.isclass(function):
        return with_shapes_checked(function, typechecker=typechecker)
    if not re.search(r"\[(\w+\.)*(Tensor|ndarray), ", str(function.__annotations__)):
        return function
    with_check, test, calls = None, running_test, 0

    @functools.wraps(function)
    def called(*arguments, **options):
        nonlocal with_check, test, calls
        if test != running_test:
            test, calls = running_test, 0
        calls += 1
        if calls > CHECKED_CALLS:
            return function(*arguments, **options)
        with_check = with_check or with_shapes_checked(function, typechecker=typechecker)
        return with_check(*arguments, **options)

    return called


def pytest_collection_finish():
    gc.freeze()
    gc.enable()


@pytest.fixture(autouse=True)
def _next_test():
    global running_test  # noqa: PLW0603  that of this process
    running_test = next(test_number)


# Modules that jaxtyping's import hook loads, on behalf of --jaxtyping-packages, ask for its decorator by this name.
jaxtyping.jaxtyped = lambda typechecker: lambda function: checked(function, typechecker)


@pytest.fixture(scope="session", autouse=True)
def _cache(tmp_path_factory):
    """Project scans once for all tests, and leave the user's own cache alone."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("LIDARGRIT_CACHE", str(tmp_path_factory.mktemp("cache")))
        yield


@pytest.fixture(scope="session", autouse=True)
def _streets():
    """Simulate each street that data sets read or write, or a script asks for, once for all tests in one process.

    Tests of the simulator import the function itself.
    """
    from lidargrit.scans.sensors import load_sensor
    from lidargrit.simulator import simulate  # now its functions come with their checks

    kept = OrderedDict()

    @functools.wraps(simulate)
    def simulate_once(seed, sensor=None, **options):
        street = (seed, sensor and json.dumps(load_sensor(sensor).to_json()), repr(options))
        found = kept.get(street)  # threads may ask at once
        if found is None:
            found = kept[street] = simulate(seed, sensor, **options)
            if len(kept) > STREETS_KEPT:
                kept.popitem(last=False)
        return copy.deepcopy(found)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("lidargrit.simulator.simulate", simulate_once)
        patch.setattr("lidargrit.simulate", simulate_once)
        yield


@pytest.fixture(autouse=True)
def _signal_handlers():
    """Fail a test that leaves signals handled otherwise; programs that later tests start inherit what is ignored."""
    before = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    yield
    left = {number: handler for number in before if (handler := signal.getsignal(number)) is not before[number]}
    for number in left:
        signal.signal(number, before[number])
    assert not left


class Listener(reporting.Reporter):
    def __init__(self) -> None:
        self.lines: list[str] = []

    def message(self, text: str) -> None:
        self.lines.append(text)


@pytest.fixture
def heard() -> Iterator[list[str]]:
    """Yield the lines that are reported while a test runs."""
    listener = Listener()
    with reporting.to(listener):
        yield listener.lines


@pytest.fixture
def untyped(monkeypatch):
    """Let values of any type reach our own checks, as they do outside of the tests."""
    monkeypatch.setattr(jaxtyping.config, "jaxtyping_disable", True)


@pytest.fixture(scope="session")
def _browser(tmp_path_factory):
    """Return a browser without a screen, one for all tests in one process."""
    if CHROMIUM is None:
        pytest.skip("needs Chromium")
    opened = Browser(tmp_path_factory.mktemp("profile"))
    yield opened
    opened.close()


@pytest.fixture(scope="module")
def browser(_browser):
    """Return the browser for the tests of a file, whose last page goes on moving no longer than they run."""
    yield _browser
    _browser.send("Page.navigate", url="about:blank")


@pytest.fixture(scope="session")
def shared() -> Path:
    if not SHARED.is_dir():
        pytest.skip("needs the reference numbers and real scans, which do not travel with the project")
    return SHARED


@pytest.fixture(scope="session")
def golden(shared):
    """Return a function that loads one file of reference numbers."""
    return lambda name: dict(np.load(shared / "goldens" / f"{name}.npz", allow_pickle=False))


@pytest.fixture(scope="session")
def real(shared) -> Path:
    return shared / "data" / "real"
