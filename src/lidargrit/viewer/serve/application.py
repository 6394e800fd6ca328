"""HTTP requests → responses, by WSGI: the page and its scripts, models, jobs, results, and files to save.

No path of a request is used as a path on disk: it is compared with a handful of routes. A request whose Host is not
a name of this machine is refused, so that no web page elsewhere can reach this server through somebody's browser.
"""

import dataclasses
import functools
import ipaddress
import json
import re
import shutil
import socket
import tempfile
import urllib.parse
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch

from lidargrit.core.errors import ConfigError, LidarGritError, OutputError, one_of
from lidargrit.core.untrusted import SEED_AT_MOST
from lidargrit.core.version import __version__
from lidargrit.data import formats
from lidargrit.scans.planes import PLANES
from lidargrit.scans.projection import unproject
from lidargrit.scans.sensors import SensorModel
from lidargrit.scans.types import RangeImage
from lidargrit.viewer import interactive
from lidargrit.viewer._page import asset, part
from lidargrit.viewer.serve.jobs import Job, JobQueue
from lidargrit.viewer.serve.requests import (
    EXAMPLES,
    TASKS,
    SampleRequest,
    parse_json_object,
    parse_request,
    upload_ending,
    upload_endings,
)
from lidargrit.viewer.serve.worker import NO_ROOM, PAGE_FILE, PIXELS_FILE

LOOPBACK_NAMES = frozenset({"127.0.0.1", "localhost", "::1"})
ALL_ADDRESSES = frozenset({"0.0.0.0", "::", ""})  # as a host to listen at: every address of this machine
_WRITERS = {"npz": "numpy_array", "ply": "ply", "bin": "kitti_bin"}  # endings of files to save → formats
_JOB = re.compile(r"/jobs/([\w-]{1,40})(?:/(scans|(\d{1,3})-(\d{1,3})\.(\w{1,4})))?")
_HOST = re.compile(r"(?:\[([0-9a-fA-F:.]+)\]|([\w.-]+))(?::\d{1,5})?")
_HEADERS = [
    (
        "Content-Security-Policy",
        "default-src 'none'; script-src 'self'; style-src 'self'; connect-src 'self'; img-src data:; base-uri 'none'; "
        "form-action 'none'; frame-ancestors 'none'",
    ),
    ("X-Content-Type-Options", "nosniff"),
    ("Cross-Origin-Resource-Policy", "same-origin"),
    ("Cross-Origin-Opener-Policy", "same-origin"),
    ("Referrer-Policy", "no-referrer"),
    ("Cache-Control", "no-store"),
]

Environment = dict[str, Any]


class Response(NamedTuple):
    """The response to a request.

    Args:
        file_name: name under which a browser saves the content; "" to show it.
    """

    status: str
    body: bytes
    media_type: str = "application/json"
    file_name: str = ""


class RefusedRequestError(Exception):
    """A request that is refused, with the response that says why."""

    def __init__(self, status: str, why: str) -> None:
        super().__init__(why)
        self.response = Response(status, json.dumps({"error": why}).encode())


class Application:
    """The WSGI application of the server.

    Args:
        host: address at which it is served; the loopback's names are known besides.
    """

    def __init__(self, queue: JobQueue, host: str = "127.0.0.1") -> None:
        self._queue, self._host = queue, host
        models = [{name: value for name, value in model.items() if name != "rays"} for model in queue.models]
        limits = {"scans": queue.limits.scans, "uploadBytes": queue.limits.upload_bytes}
        self._fixed = {
            "/": Response("200 OK", page().encode(), "text/html; charset=utf-8"),
            "/page.js": Response("200 OK", script().encode(), "text/javascript; charset=utf-8"),
            "/page.css": Response("200 OK", style().encode(), "text/css; charset=utf-8"),
            "/models": Response("200 OK", json.dumps({"models": models, "limits": limits}).encode()),
        }
        self._settings = queue.settings()

    def __call__(self, environment: Environment, start: Callable[[str, list[tuple[str, str]]], Any]) -> Iterable[bytes]:
        """Respond to a request, as WSGI wants it."""
        try:
            response = self._respond(environment)
        except RefusedRequestError as refused:
            response = refused.response
        except LidarGritError as error:
            response = RefusedRequestError("400 Bad Request", str(error)).response
        headers = [("Content-Type", response.media_type), ("Content-Length", str(len(response.body))), *_HEADERS]
        if response.file_name:
            headers.append(("Content-Disposition", f'attachment; filename="{response.file_name}"'))
        start(response.status, headers)
        return [] if environment["REQUEST_METHOD"] == "HEAD" else [response.body]

    def _respond(self, environment: Environment) -> Response:
        host = environment.get("HTTP_HOST", "")
        if not is_own(host, self._host):
            known = "as localhost" if self._host in LOOPBACK_NAMES else "by the numeric address of this machine"
            why = f"This page is not served under this name: open it {known}, or serve it with --host NAME."
            raise RefusedRequestError("403 Forbidden", why)
        method, path = environment["REQUEST_METHOD"], environment["PATH_INFO"]
        if method in ("GET", "HEAD"):
            return self._get(path)
        if method != "POST" or path not in ("/generate", "/complete"):
            raise RefusedRequestError("405 Method Not Allowed", "Only GET, and POST to /generate or /complete.")
        if environment.get("HTTP_ORIGIN", "") != f"http://{host}":
            raise RefusedRequestError("403 Forbidden", "Only the page itself may send this request.")
        return self._submit(environment, path)

    def _get(self, path: str) -> Response:
        if path in self._fixed:
            return self._fixed[path]
        found = _JOB.fullmatch(path)
        job = self._queue.job(found[1]) if found else None
        if found is None or job is None:
            raise RefusedRequestError("404 Not Found", "There is nothing here, or it is no longer kept.")
        if not found[2]:
            state = {"state": job.state, "before": self._queue.jobs_before(job), "seconds": round(job.seconds(), 1)}
            return Response("200 OK", json.dumps({**state, "error": job.error}).encode())
        try:
            if job.state == "done" and found[2] == "scans":
                return Response("200 OK", (job.folder / PAGE_FILE).read_bytes())
            if job.state == "done" and found[5] in _WRITERS:
                return self._file(job, int(found[3]), int(found[4]), found[5])
        except (OSError, KeyError, IndexError):  # removed meanwhile, or never there
            pass
        raise RefusedRequestError("404 Not Found", "There is no such scan, or it is no longer kept.")

    def _file(self, job: Job, scan_set: int, index: int, ending: str) -> Response:
        sensor = SensorModel.from_json(self._queue.models[job.request.model]["rays"])
        with np.load(job.folder / PIXELS_FILE, allow_pickle=False) as pixels:
            range_m = torch.from_numpy(pixels[f"range_m_{scan_set}"][index])
            kept = [name for name in PLANES if f"{name}_{scan_set}" in pixels]
            planes = {name: torch.from_numpy(pixels[f"{name}_{scan_set}"][index]) for name in kept}
        scan = unproject(RangeImage(range_m, range_m > 0, sensor, planes))
        try:
            with tempfile.TemporaryDirectory(dir=job.folder) as folder:
                path = Path(folder) / f"scan.{ending}"
                formats.load(_WRITERS[ending]).write(path, scan)
                return Response("200 OK", path.read_bytes(), "application/octet-stream", path.name)
        except OutputError:  # its message names a folder of the server
            raise RefusedRequestError("507 Insufficient Storage", str(NO_ROOM)) from None

    def _submit(self, environment: Environment, path: str) -> Response:
        """Check a request, store its upload, and add it to the queue; a refused one leaves nothing behind."""
        body, size = environment["wsgi.input"], int(environment.get("CONTENT_LENGTH") or 0)
        at_most = self._queue.limits.request_bytes  # a longer text is cut, and is then no JSON
        if path == "/generate":
            text = body.read(min(size, at_most))
        else:
            query = environment.get("QUERY_STRING", "")[:at_most]
            text = urllib.parse.unquote_to_bytes(query.removeprefix("request="))
        request = parse_request(parse_json_object(text), self._settings, self._queue.limits)
        if path == "/generate" and request.example:
            raise ConfigError(f"example={request.example!r} to generate", "no example", "ask /complete for its task")
        if path == "/complete":
            self._check_task(request)
            if not request.example:
                self._check_upload(request.name, size)
        folder, name = None, None
        try:
            folder = self._queue.new_folder()
            if path == "/complete" and not request.example:
                request = dataclasses.replace(request, file=str(folder / f"upload{upload_ending(request.name)}"))
                with Path(request.file).open("wb") as file:
                    shutil.copyfileobj(body, file)
            name = self._queue.submit(request, folder)
        except OSError:
            raise RefusedRequestError("507 Insufficient Storage", str(NO_ROOM)) from None
        finally:
            if name is None and folder is not None:
                shutil.rmtree(folder, ignore_errors=True)
        if name is None:
            busy = f"{self._queue.limits.waiting} others are waiting already: try again in a minute."
            raise RefusedRequestError("503 Service Unavailable", busy)
        return Response("202 Accepted", json.dumps({"job": name}).encode())

    def _check_task(self, request: SampleRequest) -> None:
        model = self._queue.models[request.model]
        if not model["upload"]:
            raise ConfigError(
                f"a scan for {model['name']}, which can neither complete nor reconstruct one",
                "a model that can",
                "choose another model",
            )
        if model["tasks"] and request.task not in model["tasks"]:
            raise ConfigError(
                f"the task {TASKS[request.task]!r}, which {model['name']} cannot do",
                one_of([repr(TASKS[task]) for task in model["tasks"]]),
                "choose another task",
            )

    def _check_upload(self, name: str, size: int) -> None:
        if not upload_ending(name):
            raise ConfigError(
                f"the file {name or 'without a name'!r}, which is no LiDAR scan that this page reads",
                f"one revolution in a file that ends in {', '.join(upload_endings())}",
                "choose such a file, or an example",
            )
        if not 0 < size <= self._queue.limits.upload_bytes:
            most = f"1 to {self._queue.limits.upload_bytes:,} bytes"
            raise ConfigError(f"a file of {size:,} bytes", most, "choose one revolution")


def is_own(host: str, served_at: str) -> bool:
    """Return whether a request's Host names this machine, and not a foreign name that was made to lead here.

    A page served at a loopback address accepts the loopback's names only. A page served elsewhere accepts numeric
    addresses as well: an attack through somebody's browser needs a name. One served at all addresses also accepts the
    machine's own name, which nobody else's is.
    """
    parts = _HOST.fullmatch(host)
    if parts is None:
        return False
    name = (parts[1] or parts[2]).lower()
    if served_at in LOOPBACK_NAMES or name in LOOPBACK_NAMES:
        return name in LOOPBACK_NAMES
    if name == served_at.lower() or _is_number(name):
        return True
    return served_at in ALL_ADDRESSES and name in _names_of_this_machine()


@functools.cache  # the second may ask a name server, which may take seconds
def _names_of_this_machine() -> frozenset[str]:
    return frozenset({socket.gethostname().lower(), socket.getfqdn().lower()})


def _is_number(name: str) -> bool:
    try:
        ipaddress.ip_address(name)
    except ValueError:
        return False
    return True


def page() -> str:
    """Return the page without models and scans, which its script requests from the server."""
    buttons = {kind: f".{kind}" for kind in _WRITERS} | {"remove": "Remove"}
    return part(
        "serve.html",
        viewer=interactive.viewer_html(buttons, f"lidargrit {__version__}.", label="Save"),
        tasks=TASKS,
        examples=EXAMPLES,
        seed_at_most=SEED_AT_MOST,
        endings=upload_endings(),
    )


def script() -> str:
    """Return the scripts of the page."""
    return interactive.scripts() + asset("serve.js")


def style() -> str:
    """Return the style sheet of the page."""
    return asset("page.css") + asset("serve.css")
