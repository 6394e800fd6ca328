"""A server with tiny models, and what its clients say to it, well-meaning or not."""

import http.client
import json
import socket
import threading
import time
from contextlib import contextmanager, suppress
from pathlib import Path

from lidargrit.viewer.serve import Limits
from lidargrit.viewer.serve.server import open_server
from test_generator_contract import made

MODELS = ("lidargrit", "marginal", "r2dm")
LIMITS = Limits(seconds=60.0, idle_seconds=2, upload_bytes=4_000_000)


class Served:
    """A running server, and a client."""

    def __init__(self, server) -> None:
        self.port, self.queue = server.port, server.queue
        self.host = f"127.0.0.1:{self.port}"
        self.url = f"http://{self.host}"

    def ask(self, path: str, body: bytes | dict | None = None, **headers: str) -> tuple[int, dict, bytes]:
        """Ask as the page does, unless the headers say otherwise."""
        client = http.client.HTTPConnection("127.0.0.1", self.port, timeout=30)
        own = {"Host": self.host} | ({"Origin": self.url} if body is not None else {})
        data = json.dumps(body).encode() if isinstance(body, dict) else body
        method = headers.pop("method", "GET" if body is None else "POST")
        client.putrequest(method, path, skip_host=True)
        for name, value in (own | headers).items():
            client.putheader(name, value)
        if data is not None:
            client.putheader("Content-Length", str(len(data)))
        client.endheaders(data)
        answer = client.getresponse()
        answered = answer.status, dict(answer.getheaders()), answer.read()
        client.close()
        return answered

    def refused(self, path: str, body: bytes | dict | None = None, **headers: str) -> tuple[int, str]:
        """Return the status and the one line of a request that is to be refused."""
        status, _, answer = self.ask(path, body, **headers)
        line = json.loads(answer)["error"]
        assert status >= 400
        assert line
        assert "\n" not in line
        return status, line

    def take(self, path: str, body: bytes | dict) -> str:
        """Have a request taken on, and return the job's path."""
        status, _, answer = self.ask(path, body)
        assert status == 202, answer
        return f"/jobs/{json.loads(answer)['job']}"

    def ended(self, job: str) -> dict:
        """Wait until a job has ended, and return what is told of it."""
        end = time.monotonic() + 60
        while True:
            state = json.loads(self.ask(job)[2])
            if state["state"] in ("done", "failed"):
                return state
            assert time.monotonic() < end
            time.sleep(0.03)

    def say(self, data: bytes, seconds: float = 10.0) -> tuple[bytes, float]:
        """Send bytes as they are, and return the answer and how long it took until the server hung up."""
        begun = time.monotonic()
        with socket.create_connection(("127.0.0.1", self.port), seconds) as client:
            client.sendall(data)
            parts = []
            with suppress(ConnectionResetError):  # it did not read all that was sent
                while part := client.recv(65536):
                    parts.append(part)
        return b"".join(parts), time.monotonic() - begun


@contextmanager
def running(folder: Path):
    """Serve one tiny run of each kind."""
    for name in MODELS:
        made(name)[0].save(folder / f"tiny-{name}")
    with open_server([folder / f"tiny-{name}" for name in MODELS], limits=LIMITS) as server:
        thread = threading.Thread(target=server.run, daemon=True)
        thread.start()
        try:
            yield Served(server)
        finally:
            server.stop()
            thread.join(10)
    assert not thread.is_alive()
