"""A browser without a screen, driven by its own protocol over two pipes: pages are clicked and typed at, and seen."""

import base64
import io
import itertools
import json
import os
import select
import shutil
import subprocess
import time
from pathlib import Path

import numpy as np
from PIL import Image

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
SECONDS_AT_MOST = 60.0  # for one answer: the machine may be busy with other tests


class Browser:
    """One Chromium with one page, 1366 x 768 as small laptops have it."""

    def __init__(self, profile: Path, width: int = 1366, height: int = 768) -> None:
        assert CHROMIUM
        theirs_in, self._write = os.pipe()
        self._read, theirs_out = os.pipe()

        def wire() -> None:  # the protocol is spoken on 3 and 4
            first, second = os.dup(theirs_in), os.dup(theirs_out)  # neither of which may be 3 or 4 already
            os.dup2(first, 3)
            os.dup2(second, 4)

        words = ["--headless=new", "--no-sandbox", "--remote-debugging-pipe", f"--user-data-dir={profile}"]
        words += ["--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--disable-dev-shm-usage"]
        words += ["--no-first-run", "--disable-extensions", "--disable-background-networking", "--mute-audio"]
        self._process = subprocess.Popen(
            [CHROMIUM, *words, "about:blank"],
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            close_fds=False,
            preexec_fn=wire,  # noqa: PLW1509  it takes no lock
        )
        os.close(theirs_in)
        os.close(theirs_out)
        self._numbers, self._buffer, self._session = itertools.count(1), b"", ""
        self.events: list[dict] = []
        targets = self.send("Target.getTargets")["targetInfos"]
        target = next(one["targetId"] for one in targets if one["type"] == "page")
        self._session = self.send("Target.attachToTarget", targetId=target, flatten=True)["sessionId"]
        for domain in ("Page", "Runtime", "Log", "Network"):
            self.send(f"{domain}.enable")
        self.send("Emulation.setDeviceMetricsOverride", width=width, height=height, deviceScaleFactor=1, mobile=False)

    def send(self, method: str, **parameters: object) -> dict:
        """Give an order, and return its answer."""
        number = next(self._numbers)
        message = {"id": number, "method": method, "params": parameters}
        os.write(
            self._write,
            json.dumps({**message, **({"sessionId": self._session} if self._session else {})}).encode() + b"\0",
        )
        while True:
            answer = self._receive()
            if answer.get("id") == number:
                assert "error" not in answer, (method, answer["error"])
                return answer["result"]
            self.events.append(answer)

    def _receive(self) -> dict:
        end = time.monotonic() + SECONDS_AT_MOST
        while b"\0" not in self._buffer:
            ready, _, _ = select.select([self._read], [], [], max(0.0, end - time.monotonic()))
            data = os.read(self._read, 1 << 20) if ready else b""
            assert data, "the browser does not answer"
            self._buffer += data
        one, _, self._buffer = self._buffer.partition(b"\0")
        return json.loads(one)

    def open(self, path: Path) -> None:
        """Open a page of this machine, and wait until it is drawn."""
        self.events.clear()
        self.send("Page.navigate", url=path.as_uri())
        self.wait("document.readyState === 'complete'")
        self.settle()

    def run(self, script: str) -> object:
        """Evaluate JavaScript on the page, and return what comes of it."""
        answer = self.send("Runtime.evaluate", expression=script, returnByValue=True, awaitPromise=True)
        assert "exceptionDetails" not in answer, answer["exceptionDetails"]
        return answer["result"].get("value")

    def wait(self, condition: str) -> None:
        """Wait until a condition holds on the page."""
        end = time.monotonic() + SECONDS_AT_MOST
        while not self.run(condition):
            assert time.monotonic() < end, condition
            time.sleep(0.02)

    def settle(self) -> None:
        """Wait until what was asked for is drawn."""
        self.wait("document.querySelector('[aria-busy]')?.ariaBusy !== 'true'")
        self.run("new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(() => done(true))))")

    def box(self, selector: str, which: int = 0) -> tuple[float, float, float, float]:
        """Return left, top, width and height of an element on the screen."""
        one = f"document.querySelectorAll({selector!r})[{which}].getBoundingClientRect()"
        script = f"(({{left, top, width, height}}) => [left, top, width, height])({one})"
        left, top, width, height = self.run(script)
        return left, top, width, height

    def move(self, x: float, y: float, buttons: int = 0) -> None:
        """Move the pointer."""
        self.send("Input.dispatchMouseEvent", type="mouseMoved", x=x, y=y, buttons=buttons)
        self.settle()

    def click(self, selector: str, which: int = 0) -> None:
        """Press and release the button in the middle of an element, once it is in sight."""
        self.run(f"document.querySelectorAll({selector!r})[{which}].scrollIntoView({{block: 'nearest'}})")
        left, top, width, height = self.box(selector, which)
        self.drag((left + width / 2, top + height / 2), (left + width / 2, top + height / 2))

    def drag(self, start: tuple[float, float], end: tuple[float, float]) -> None:
        """Press the button at one place, and release it at another."""
        self.move(*start)
        button = {"button": "left", "clickCount": 1}
        self.send("Input.dispatchMouseEvent", type="mousePressed", x=start[0], y=start[1], buttons=1, **button)
        if end != start:
            self.move(*end, buttons=1)
        self.send("Input.dispatchMouseEvent", type="mouseReleased", x=end[0], y=end[1], buttons=0, **button)
        self.settle()

    def press(self, key: str, modifiers: int = 0) -> None:
        """Press and release a key."""
        codes = {"ArrowLeft": 37, "ArrowUp": 38, "ArrowRight": 39, "ArrowDown": 40, "Tab": 9, " ": 32}
        text = {"text": key} if len(key) == 1 else {}
        parts = {"key": key, "windowsVirtualKeyCode": codes.get(key, ord(key[0].upper())), "modifiers": modifiers}
        self.send("Input.dispatchKeyEvent", type="keyDown", **parts, **text)
        self.send("Input.dispatchKeyEvent", type="keyUp", **parts)
        self.settle()

    def screenshot(self, selector: str = "html", which: int = 0) -> np.ndarray:
        """Return what is seen of an element, as red, green and blue."""
        left, top, width, height = self.box(selector, which)
        clip = {"x": left, "y": top, "width": width, "height": height, "scale": 1}
        data = self.send("Page.captureScreenshot", clip=clip, captureBeyondViewport=True)["data"]
        with Image.open(io.BytesIO(base64.b64decode(data))) as image:
            return np.array(image.convert("RGB"))

    def troubles(self) -> list[str]:
        """Return what the page complained of."""
        found = [one for one in self.events if one.get("method") in ("Runtime.exceptionThrown", "Log.entryAdded")]
        return [json.dumps(one["params"])[:400] for one in found]

    def requests(self) -> list[str]:
        """Return what the page asked the network for."""
        sent = [
            one["params"]["request"]["url"] for one in self.events if one.get("method") == "Network.requestWillBeSent"
        ]
        return [url for url in sent if not url.startswith(("file:", "data:", "blob:"))]

    def close(self) -> None:
        """End the browser, and everything that it started."""
        os.write(self._write, json.dumps({"id": 0, "method": "Browser.close", "params": {}}).encode() + b"\0")
        try:
            self._process.wait(10)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        os.close(self._write)
        os.close(self._read)
