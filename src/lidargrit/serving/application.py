"""Requests → answers, by WSGI: the page and its scripts, models, requests, results, and files to save.

No path of a request is ever a path on disk: it is compared with a handful of routes. Whoever is not asked for by a
name of ours is refused, so that no web page elsewhere can talk to this one through somebody's browser.
"""

from __future__ import annotations

import dataclasses
import ipaddress
import json
import re
import shutil
import tempfile
import urllib.parse
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch

from lidargrit import formats
from lidargrit._discovery import names
from lidargrit.errors import ConfigError, LidarGritError
from lidargrit.formats import candidates
from lidargrit.projection import unproject
from lidargrit.sensors import SensorModel
from lidargrit.serving.jobs import Job, JobQueue
from lidargrit.serving.page import page, script, style
from lidargrit.serving.requests import parse_json_object, parse_request
from lidargrit.serving.worker import PAGE_FILE, PIXELS_FILE
from lidargrit.structures import RangeImage

LOOPBACK_NAMES = frozenset({"127.0.0.1", "localhost", "::1"})
_WRITERS = {"npz": "numpy_array", "ply": "ply", "bin": "kitti_bin"}  # endings of files to save → formats
_RESULT = re.compile(r"/jobs/([\w-]{1,40})(?:/(scans|(\d{1,3})-(\d{1,3})\.(\w{1,4})))?")
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
    """What a request gets.

    Args:
        status: of HTTP.
        body: all of it.
        kind: its media type.
        name: to save it by; "" to show it.
    """

    status: str
    body: bytes
    kind: str = "application/json"
    name: str = ""


class RefusedRequestError(Exception):
    """A request that gets no answer but why."""

    def __init__(self, status: str, why: str) -> None:
        super().__init__(why)
        self.answer = Response(status, json.dumps({"error": why}).encode())


class Application:
    """Answers requests.

    Args:
        queue: runs the jobs.
        host: at which it is served; names of this machine's own are known besides.
    """

    def __init__(self, queue: JobQueue, host: str = "127.0.0.1") -> None:
        self._queue, self._host = queue, host
        models = [{name: of for name, of in model.items() if name != "rays"} for model in queue.models]
        limits = {"scans": queue.limits.scans, "uploadBytes": queue.limits.upload_bytes}
        self._fixed = {
            "/": Response("200 OK", page().encode(), "text/html; charset=utf-8"),
            "/page.js": Response("200 OK", script().encode(), "text/javascript; charset=utf-8"),
            "/page.css": Response("200 OK", style().encode(), "text/css; charset=utf-8"),
            "/models": Response("200 OK", json.dumps({"models": models, "limits": limits}).encode()),
        }
        self._settings = queue.settings()

    def __call__(self, environment: Environment, start: Callable[[str, list[tuple[str, str]]], Any]) -> Iterable[bytes]:
        """Answer a request, as WSGI wants it."""
        try:
            answer = self._answer(environment)
        except RefusedRequestError as refused:
            answer = refused.answer
        except LidarGritError as error:
            answer = RefusedRequestError("400 Bad Request", str(error)).answer
        headers = [("Content-Type", answer.kind), ("Content-Length", str(len(answer.body))), *_HEADERS]
        if answer.name:
            headers.append(("Content-Disposition", f'attachment; filename="{answer.name}"'))
        start(answer.status, headers)
        return [answer.body]

    def _answer(self, environment: Environment) -> Response:
        host = environment.get("HTTP_HOST", "")
        if not is_own(host, self._host):
            raise RefusedRequestError("403 Forbidden", "This address is not one that this page is served at.")
        method, path = environment["REQUEST_METHOD"], environment["PATH_INFO"]
        if method == "GET":
            return self._get(path)
        if method != "POST" or path not in ("/generate", "/complete"):
            raise RefusedRequestError("405 Method Not Allowed", "This page takes GET, and POST of a request.")
        if environment.get("HTTP_ORIGIN", "") != f"http://{host}":
            raise RefusedRequestError("403 Forbidden", "A request comes from the page itself, and from no other.")
        return self._taken_on(environment, path)

    def _get(self, path: str) -> Response:
        if path in self._fixed:
            return self._fixed[path]
        named = _RESULT.fullmatch(path)
        job = self._queue.job(named[1]) if named else None
        if named is None or job is None:
            raise RefusedRequestError("404 Not Found", "There is nothing here, or it is no longer kept.")
        if not named[2]:
            told = {"state": job.state, "before": self._queue.before(job), "seconds": round(job.seconds(), 1)}
            return Response("200 OK", json.dumps({**told, "error": job.error}).encode())
        try:
            if job.state == "done" and named[2] == "scans":
                return Response("200 OK", (job.folder / PAGE_FILE).read_bytes())
            if job.state == "done" and named[5] in _WRITERS:
                return self._file(job, int(named[3]), int(named[4]), named[5])
        except (OSError, KeyError, IndexError):  # forgotten meanwhile, or never there
            pass
        raise RefusedRequestError("404 Not Found", "There is no such scan, or it is no longer kept.")

    def _file(self, job: Job, group: int, index: int, kind: str) -> Response:
        """Write a scan as other programs read it."""
        sensor = SensorModel.from_json(self._queue.models[job.request.model]["rays"])
        with np.load(job.folder / PIXELS_FILE, allow_pickle=False) as pixels:
            range_m = torch.from_numpy(pixels[f"range_m_{group}"][index])
            reflectance = pixels.get(f"reflectance_{group}")
        kept = None if reflectance is None else torch.from_numpy(reflectance[index])
        scan = unproject(RangeImage(range_m, range_m > 0, sensor, kept))
        with tempfile.TemporaryDirectory(dir=job.folder) as folder:
            path = Path(folder) / f"scan.{kind}"
            formats.load(_WRITERS[kind]).write(path, scan)
            return Response("200 OK", path.read_bytes(), "application/octet-stream", path.name)

    def _taken_on(self, environment: Environment, path: str) -> Response:
        """Check a request, and let it wait for its turn."""
        body, size = environment["wsgi.input"], int(environment.get("CONTENT_LENGTH") or 0)
        if path == "/generate":
            words = body.read(min(size, self._queue.limits.request_bytes))
            request = parse_request(parse_json_object(words), self._settings, self._queue.limits)
        else:
            words = environment.get("QUERY_STRING", "")[: self._queue.limits.request_bytes].removeprefix("request=")
            request = parse_request(
                parse_json_object(urllib.parse.unquote_to_bytes(words)), self._settings, self._queue.limits
            )
            self._check_upload(request.model, request.name, size)
        folder = self._queue.new_folder()
        if path == "/complete":
            request = dataclasses.replace(request, file=str(folder / f"upload{_suffix(request.name)}"))
            with Path(request.file).open("wb") as file:
                shutil.copyfileobj(body, file)
        name = self._queue.submit(request, folder)
        if name is None:
            shutil.rmtree(folder, ignore_errors=True)
            waiting = self._queue.limits.waiting
            raise RefusedRequestError(
                "503 Service Unavailable", f"{waiting} others are waiting already: try again in a minute."
            )
        return Response("202 Accepted", json.dumps({"job": name}).encode())

    def _check_upload(self, model: int, name: str, size: int) -> None:
        about = self._queue.models[model]
        if not about["upload"]:
            raise ConfigError(
                f"a scan for {about['name']}, which can neither complete nor reconstruct one",
                "a model that can",
                "choose another model",
            )
        if not _suffix(name):
            raise ConfigError(
                f"the file {name or 'without a name'!r}, whose ending we do not know", _known(), "convert it"
            )
        if not 0 < size <= self._queue.limits.upload_bytes:
            most = f"1 to {self._queue.limits.upload_bytes:,} bytes"
            raise ConfigError(f"a file of {size:,} bytes", most, "choose one revolution")


def is_own(host: str, served_at: str) -> bool:
    """Tell whether a request's Host names this machine, and not a name of somebody else's that leads here.

    A page served at a loopback address knows the loopback's names only. Elsewhere numbers are right as well: who wants
    to lead a browser astray needs a name of their own.
    """
    parts = _HOST.fullmatch(host)
    if parts is None:
        return False
    name = (parts[1] or parts[2]).lower()
    if served_at in LOOPBACK_NAMES or name in LOOPBACK_NAMES:
        return name in LOOPBACK_NAMES
    return name == served_at.lower() or _is_number(name)


def _is_number(name: str) -> bool:
    try:
        ipaddress.ip_address(name)
    except ValueError:
        return False
    return True


def _suffix(name: str) -> str:
    """Return the ending by which a format knows its files, "" if none does."""
    endings = [suffix for form in candidates(Path(name)) for suffix in form.suffixes]
    return max((one for one in endings if name.lower().endswith(one)), key=len, default="")


def _known() -> str:
    return f"one of {', '.join(sorted({one for name in names('formats') for one in formats.load(name).suffixes}))}"
