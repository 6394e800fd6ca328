"""Clients of the page that is served who mean no good, or are many: each is answered in one line, and it goes on."""

import errno
import io
import json
import os
import pickle
import re
import signal
import socket
import tempfile
import threading
import time
import urllib.parse
import zipfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import lidargrit
from lidargrit.core.errors import OutputError
from lidargrit.data.formats import load, read_scan
from lidargrit.viewer.serve import application
from lidargrit.viewer.serve.application import is_own
from lidargrit.viewer.serve.requests import TASKS
from lidargrit.viewer.serve.server import _listening
from served import LIMITS, running

QUICK = {"steps": 3, "resamples": 2}
LONG = {"model": 2, "count": 8, "sampling": {"steps": 1024}}


@pytest.fixture(scope="module")
def served(tmp_path_factory):
    with running(tmp_path_factory.mktemp("runs")) as served:
        yield served


def upload(served, path: Path, request: dict) -> str:
    words = urllib.parse.quote(json.dumps({"name": path.name, **request}))
    return served.take(f"/complete?request={words}", path.read_bytes())


def test_every_answer_forbids_what_it_does_not_need(served):
    for path in ("/", "/page.js", "/page.css", "/models", "/nothing"):
        status, headers, body = served.ask(path)
        assert status == (404 if path == "/nothing" else 200)
        assert headers["Content-Security-Policy"].startswith("default-src 'none'; script-src 'self'; style-src 'self'")
        assert headers["X-Content-Type-Options"] == "nosniff"
        assert "Access-Control-Allow-Origin" not in headers
        assert b"http://" not in body
        assert b"https://" not in body
    assert b"<script>" not in served.ask("/")[2]


@pytest.mark.parametrize(
    "host",
    ["evil.example", "evil.example:8000", "127.0.0.1.evil.example", "localhost.evil", "", "[::1", "a b", "127.0.0.2"],
)
def test_a_name_that_somebody_else_made_lead_here_is_refused(served, host):
    for path in ("/", "/models"):
        assert served.refused(path, Host=host)[0] in (400, 403)
    assert served.refused("/generate", {}, Host=host, Origin=f"http://{host}")[0] in (400, 403)


def test_which_names_are_our_own():
    for host in ("127.0.0.1", "localhost:9000", "[::1]:8000", "LOCALHOST"):
        assert is_own(host, "127.0.0.1")
    assert not is_own("192.168.0.7", "127.0.0.1")
    assert is_own("192.168.0.7:8000", "0.0.0.0")
    assert is_own("box.lan", "box.lan")
    assert not is_own("evil.example", "0.0.0.0")
    for served_at in ("0.0.0.0", "::"):
        assert is_own(f"{socket.gethostname().upper()}:8000", served_at)
        assert is_own(socket.getfqdn(), served_at)
    assert not is_own(f"{socket.gethostname()}.evil.example", "0.0.0.0")
    assert not is_own(socket.gethostname(), "127.0.0.1")


def test_a_refused_name_is_told_how_to_get_in(served):
    status, why = served.refused("/", Host="box.lan")
    assert status == 403
    assert why.endswith("open it as localhost, or serve it with --host NAME.")
    everywhere = application.Application(served.queue, "0.0.0.0")
    answer = b"".join(everywhere({"HTTP_HOST": "box.lan", "REQUEST_METHOD": "GET"}, lambda *_: None)).decode()
    assert "open it by the numeric address of this machine, or serve it with --host NAME." in answer


@pytest.mark.parametrize("host", ["no.such.host.invalid", "192.0.2.1"])  # the second is an address of nobody
def test_a_wrong_host_is_no_matter_of_the_port(host):
    with pytest.raises(OutputError, match=r"wanted an address or a name of this machine; .* --host") as refused:
        _listening(host, 0)
    assert "--port" not in str(refused.value)
    with socket.create_server(("127.0.0.1", 0)) as other, pytest.raises(OutputError, match="by --port"):
        _listening("127.0.0.1", other.getsockname()[1])


@pytest.mark.parametrize("origin", ["http://evil.example", "null", "", "https://127.0.0.1", "http://127.0.0.1:1"])
def test_a_request_from_another_page_is_refused(served, origin):
    for path in ("/generate", "/complete"):
        assert served.refused(path, {}, Origin=origin)[0] == 403


@pytest.mark.parametrize(
    "path",
    [
        "/../page.js",
        "/page.js/..",
        "/%2e%2e/%2e%2e/etc/passwd",
        "/..%2f..%2fetc%2fpasswd",
        "//etc/passwd",
        "/etc/passwd",
        "/browser/serve.html",
        "/jobs/../models",
        "/jobs/%00",
        "/jobs/x/0-0.ply",
        "/jobs/" + "x" * 5000,
        "/C:%5Cx",
        "/.git",
    ],
)
def test_paths_lead_nowhere_else(served, path):
    assert served.refused(path)[0] == 404


def test_results_are_had_by_their_names_only(served):
    job = served.take("/generate", {"model": 1, "count": 2})
    assert served.ended(job)["state"] == "done"
    assert served.ask(f"{job}/0-1.ply")[0] == 200
    for name in ("0-2.ply", "1-0.ply", "0-0.pkl", "0-0.npz/..", "999-999.bin", "page.json", "../0-0.ply", "0--1.ply"):
        assert served.ask(f"{job}/{name}")[0] == 404
    for method in ("PUT", "DELETE", "OPTIONS", "TRACE"):
        assert served.ask("/models", method=method)[0] == 405
    assert served.refused("/models", {})[0] == 405


@pytest.mark.parametrize(("path", "status"), [("/models", b"200 OK"), ("/nothing", b"404 Not Found")])
def test_what_is_asked_for_its_head_has_no_body(served, path, status):
    answers = [
        served.say(f"{method} {path} HTTP/1.0\r\nHost: {served.host}\r\n\r\n".encode())[0] for method in ("HEAD", "GET")
    ]
    heads, bodies = zip(*(answer.split(b"\r\n\r\n", 1) for answer in answers), strict=True)
    assert status in heads[0].splitlines()[0]
    lengths = [re.findall(rb"Content-Length: (\d+)", head) for head in heads]
    assert lengths[0] == lengths[1] == [str(len(bodies[1])).encode()]
    assert bodies[0] == b""


def test_labels_that_the_page_shows_are_saved(served, tmp_path):
    scan = lidargrit.simulate(seed=5)
    load("ply").write(tmp_path / "a.ply", scan)
    job = upload(served, tmp_path / "a.ply", {"model": 2, "task": "region"})
    assert served.ended(job)["state"] == "done"
    for ending in ("ply", "npz"):
        saved = tmp_path / f"saved.{ending}"
        saved.write_bytes(served.ask(f"{job}/0-0.{ending}")[2])
        label = read_scan(saved).label
        assert label is not None
        assert set(label.unique().tolist()) <= set((scan.label & 0xFFFF).tolist()), "without the numbers of instances"
        assert len(label.unique()) > 3


def bombs() -> dict[str, bytes]:
    """Return files that unpack to far more than they are, that are code, or that say what is not so."""
    found = {
        "code.npy": b"",
        "zip.npz": b"",
        "many.npz": b"",
        "head.ply": b"ply\nformat ascii 1.0\nelement vertex 4000000\n",
    }
    with io.BytesIO() as buffer:
        np.save(buffer, np.array([{"a": 1}], dtype=object), allow_pickle=True)
        found["code.npy"] = buffer.getvalue()
    found["pickle.npz"] = pickle.dumps({"points": 1})
    points = io.BytesIO()
    np.save(points, np.ones((8, 3), np.float32))
    for name, sizes in (
        ("zip.npz", {"points": 600_000_000}),
        ("many.npz", {"points": 0, "i": 99_000_000, "I": 99_000_000}),
    ):
        with io.BytesIO() as buffer:
            with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive:
                for member, size in sizes.items():
                    with archive.open(f"{member}.npy", "w") as file:
                        file.write(points.getvalue())
                        for _ in range(size // 1_000_000):
                            file.write(bytes(1_000_000))
            found[name] = buffer.getvalue()
    return found


def test_hostile_files_are_refused_and_removed(served, tmp_path):
    status = Path(f"/proc/{served.queue._worker._process.pid}/status")
    jobs = {}
    for name, data in bombs().items():
        (tmp_path / name).write_bytes(data)
        assert len(data) < LIMITS.upload_bytes
        jobs[name] = upload(served, tmp_path / name, {"model": 2, "sampling": QUICK})
        job = served.ended(jobs[name])
        assert job["state"] == "failed", name
        assert name in job["error"]
        assert str(served.queue._folder) not in job["error"]
        assert served.ask(f"{jobs[name]}/scans")[0] == 404
    if status.exists():
        most_kb = int(re.search(r"VmHWM:\s+(\d+)", status.read_text())[1])
        assert most_kb < 1_500_000, "no more than the program takes anyway, and one array"
    assert not list(served.queue._folder.rglob("upload*"))
    assert served.ended(served.take("/generate", {"model": 1}))["state"] == "done", "the same process goes on"


def test_a_worker_that_ends_within_a_line_ends_one_job_only(served):
    served.queue._worker._lines.put('{"done": tr')
    ended = served.ended(served.take("/generate", {"model": 1}))
    assert ended["state"] == "failed"
    assert "during which the program ended" in ended["error"]
    assert served.ended(served.take("/generate", {"model": 1}))["state"] == "done", "later jobs run"


def test_an_upload_onto_a_full_disk_is_refused_in_one_line_and_removed(served, monkeypatch, capfd):
    def full(source=None, file=None) -> None:
        if file is not None:
            file.write(source.read(1000))
            file.flush()
        raise OSError(errno.ENOSPC, "No space left on device")

    before = sorted(served.queue._folder.iterdir())
    monkeypatch.setattr(application.shutil, "copyfileobj", full)
    monkeypatch.setattr(tempfile, "TemporaryFile", full)  # where large bodies would wait
    words = urllib.parse.quote(json.dumps({"name": "a.bin", "model": 2}))
    status, why = served.refused(f"/complete?request={words}", bytes(3_000_000))
    assert status == 507
    assert "no room on the server's disk" in why
    assert str(served.queue._folder) not in why
    assert sorted(served.queue._folder.iterdir()) == before
    assert capfd.readouterr().err == ""


def test_a_file_that_needs_another_beside_it_is_not_offered(served):
    assert b".pcap" not in served.ask("/")[2]
    words = urllib.parse.quote(json.dumps({"name": "drive.pcap", "model": 2}))
    status, why = served.refused(f"/complete?request={words}", b"x" * 100)
    assert status == 400
    assert "which is no LiDAR scan that this page reads" in why
    assert ".ply" in why
    assert why.count(".pcap") == 1


def test_a_task_that_a_model_cannot_do_is_refused_at_once_in_words_of_the_page(served):
    models = json.loads(served.ask("/models")[2])["models"]
    lacking = [
        (at, task) for at, one in enumerate(models) for task in TASKS if one["tasks"] and task not in one["tasks"]
    ]
    assert lacking
    for model, task in lacking:
        words = urllib.parse.quote(json.dumps({"name": "a.ply", "model": model, "task": task}))
        status, why = served.refused(f"/complete?request={words}", b"x" * 100)
        assert status == 400
        assert f"got the task {TASKS[task]!r}, which " in why
        assert "--" not in why


def test_too_much_is_cut_off_without_being_read(served):
    head = f"POST /complete HTTP/1.1\r\nHost: {served.host}\r\nOrigin: {served.url}\r\n"
    answer, seconds = served.say(f"{head}Content-Length: 99999999999\r\n\r\n".encode() + bytes(1000))
    assert answer.startswith(b"HTTP/1.1 413")
    chunk = b"100000\r\n" + bytes(0x100000) + b"\r\n"
    answer, _ = served.say(f"{head}Transfer-Encoding: chunked\r\n\r\n".encode() + chunk * 5)
    assert answer.startswith(b"HTTP/1.1 413") or not answer  # the last words may be lost where the line is cut
    answer, _ = served.say(f"GET / HTTP/1.1\r\nHost: {served.host}\r\nX: {'x' * 20_000}\r\n\r\n".encode())
    assert b" 431 " in answer[:20]
    assert served.refused("/generate", {"seed": 1, "task": "x" * 5000})[0] == 400
    assert served.refused("/complete?" + "request={}&" * 400, b"x")[0] == 400
    assert served.refused("/complete", b"x")[0] == 400
    assert seconds < 5


def test_quiet_clients_are_hung_up_on(served):
    found = {}

    def wait(name: str, data: bytes) -> None:
        found[name] = served.say(data, 20.0)[1]

    half = f"POST /generate HTTP/1.1\r\nHost: {served.host}\r\nOrigin: {served.url}\r\nContent-Length: 100\r\n\r\nhalf"
    threads = [
        threading.Thread(target=wait, args=one)
        for one in (("none", b""), ("head", b"GET / HT"), ("half", half.encode()))
    ]
    for thread in threads:
        thread.start()
    assert served.ask("/models")[0] == 200, "others are served meanwhile"
    for thread in threads:
        thread.join()
    assert len(found) == 3
    assert max(found.values()) < 15


def test_fifty_clients_at_once(served):
    holding = served.take("/generate", LONG)
    answers: list[int] = []

    def client() -> None:
        page = served.ask("/")[0]
        request, _, answer = served.ask("/generate", {"model": 1})
        assert page == 200
        assert request == 202 or b"others are waiting already" in answer
        answers.append(request)

    threads = [threading.Thread(target=client) for _ in range(50)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert sorted(answers) == [202] * LIMITS.waiting + [503] * (50 - LIMITS.waiting)
    waiting = served.queue._waiting[0]
    served.queue.limits = replace(LIMITS, unpolled_seconds=0.0)  # nobody asks for theirs
    os.kill(served.queue._worker._process.pid, signal.SIGKILL)  # as when memory runs out
    assert "during which the program ended" in served.ended(holding)["error"]
    end = time.monotonic() + 20
    while served.queue._waiting:
        assert time.monotonic() < end
        time.sleep(0.02)
    served.queue.limits = LIMITS
    assert LIMITS.unpolled_seconds > 120, "hidden tabs ask once a minute"
    assert waiting.error.endswith("wanted a page that stays open; press the button again")
    assert served.ended(served.take("/generate", {"model": 1}))["state"] == "done", "a new process runs it"


def test_a_server_that_ends_hangs_up(tmp_path):
    with running(tmp_path) as other:
        client = socket.create_connection(("127.0.0.1", other.port), 10)
        assert other.ask("/")[0] == 200, "it has accepted the silent client too"
    with client:
        assert client.recv(1) == b""


def test_what_takes_too_long_is_ended(served):
    served.queue.limits = replace(LIMITS, seconds=0.4)
    job = served.ended(served.take("/generate", LONG))
    served.queue.limits = LIMITS
    assert job["state"] == "failed"
    assert "takes longer than 0.4 seconds" in job["error"]
    assert job["seconds"] < 5


def test_old_results_are_forgotten(served):
    served.queue.limits = replace(LIMITS, kept=2)
    jobs = [served.take("/generate", {"model": 1}) for _ in range(4)]
    for job in jobs:
        served.ended(job)
    last = served.take("/generate", {"model": 1})
    assert [served.ask(job)[0] for job in jobs] == [404, 404, 200, 200]
    served.ended(last)
    served.queue.limits = LIMITS
