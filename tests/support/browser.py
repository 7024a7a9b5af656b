"""A headless Chromium for tests of pages, driven through its debugging pipe; it needs no other program."""

from __future__ import annotations

import base64
import json
import os
import select
import shutil
import subprocess
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
OPTIONS = (
    "--headless",
    "--no-sandbox",
    "--disable-gpu",
    "--disable-dev-shm-usage",
    "--hide-scrollbars",
    "--no-first-run",
    "--disable-background-networking",
    "--remote-debugging-pipe",
)
TIMEOUT_S = 60
VIRTUAL_KEYS = {"Tab": 9, "Enter": 13, " ": 32, "Escape": 27}


class Browser:
    """One tab of Chromium, with the requests and the messages of the console since the last `open`."""

    def __init__(self, read: int, write: int) -> None:
        self._read, self._write = read, write
        self._buffer = b""
        self._count = 0
        self.requests: list[str] = []
        self.console: list[str] = []
        target = self._call("Target.createTarget", url="about:blank")["targetId"]
        self._session: str | None = None
        self._session = self._call("Target.attachToTarget", targetId=target, flatten=True)["sessionId"]
        for domain in ("Page", "Runtime", "Network", "Log"):
            self._call(f"{domain}.enable")

    def open(self, url: str, *, width: int = 1200, height: int = 900, dark: bool = False) -> None:
        """Load a page and wait until its scripts have run."""
        self._call(
            "Page.navigate", url="about:blank"
        )  # otherwise another fragment of the same page loads nothing
        self.requests.clear()
        self.console.clear()
        features = [{"name": "prefers-color-scheme", "value": "dark" if dark else "light"}]
        self._call("Emulation.setEmulatedMedia", features=features)
        self._call(
            "Emulation.setDeviceMetricsOverride",
            width=width,
            height=height,
            deviceScaleFactor=1,
            mobile=False,
        )
        self._loaded = False
        self._call("Page.navigate", url=url)
        end = time.monotonic() + TIMEOUT_S
        while not self._loaded and time.monotonic() < end:
            self._receive()
        self.evaluate("new Promise(done => setTimeout(done, 300))")

    def evaluate(self, expression: str) -> Any:
        """Return the value of a JavaScript expression; promises are awaited.

        Raises:
            RuntimeError: The expression throws.
        """
        result = self._call(
            "Runtime.evaluate", expression=expression, awaitPromise=True, returnByValue=True, userGesture=True
        )
        if "exceptionDetails" in result:
            raise RuntimeError(json.dumps(result["exceptionDetails"])[:2000])
        return result["result"].get("value")

    def press(self, key: str) -> None:
        """Press a key, such as `Tab`, `Enter` or `a`."""
        text = {"Enter": "\r", "Tab": ""}.get(key, key)
        event = {
            "key": key,
            "text": text,
            "windowsVirtualKeyCode": VIRTUAL_KEYS.get(key, ord(key[0].upper())),
        }
        self._call("Input.dispatchKeyEvent", type="keyDown" if text else "rawKeyDown", **event)
        self._call("Input.dispatchKeyEvent", type="keyUp", key=key)

    def screenshot(self, *, full: bool = False) -> bytes:
        """Return the visible part of the page, or all of it, as PNG."""
        options: dict[str, Any] = {"captureBeyondViewport": True} if full else {}
        return base64.b64decode(self._call("Page.captureScreenshot", format="png", **options)["data"])

    def _call(self, method: str, **parameters: object) -> dict[str, Any]:
        self._count += 1
        message: dict[str, Any] = {"id": self._count, "method": method, "params": parameters}
        if getattr(self, "_session", None):
            message["sessionId"] = self._session
        os.write(self._write, json.dumps(message).encode() + b"\0")
        number = self._count
        end = time.monotonic() + TIMEOUT_S
        while time.monotonic() < end:
            response = self._receive()
            if response.get("id") == number:
                if "error" in response:
                    raise RuntimeError(f"{method}: {response['error']}")
                return dict(response["result"])
        raise TimeoutError(method)

    def _receive(self) -> dict[str, Any]:
        while b"\0" not in self._buffer:
            if not select.select([self._read], [], [], TIMEOUT_S)[0]:
                raise TimeoutError("Chromium does not respond")
            more = os.read(self._read, 1 << 16)
            if not more:
                raise RuntimeError("Chromium has ended")
            self._buffer += more
        text, _, self._buffer = self._buffer.partition(b"\0")
        message: dict[str, Any] = json.loads(text)
        parameters = message.get("params", {})
        match message.get("method"):
            case "Network.requestWillBeSent":
                self.requests.append(str(parameters["request"]["url"]))
            case "Runtime.consoleAPICalled" | "Runtime.exceptionThrown":
                self.console.append(json.dumps(parameters)[:1000])
            case "Log.entryAdded":
                self.console.append(str(parameters["entry"].get("text")))
            case "Page.loadEventFired":
                self._loaded = True
            case _:
                pass
        return message


@contextmanager
def open_browser() -> Iterator[Browser]:
    """Run Chromium while the context is open."""
    to_browser, our_write = os.pipe()
    our_read, from_browser = os.pipe()

    def inherit() -> None:
        # Chromium reads from file descriptor 3 and writes to 4. The copies keep both pipes apart from those numbers.
        source, sink = os.dup(to_browser), os.dup(from_browser)
        os.dup2(source, 3)
        os.dup2(sink, 4)

    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as profile:  # its children may still write
        process = subprocess.Popen(  # noqa: S603 - the browser
            [str(CHROMIUM), *OPTIONS, f"--user-data-dir={profile}"],
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            close_fds=False,
            preexec_fn=inherit,  # noqa: PLW1509 - the child only copies file descriptors
        )
        os.close(to_browser)
        os.close(from_browser)
        try:
            yield Browser(our_read, our_write)
        finally:
            process.terminate()
            with suppress(subprocess.TimeoutExpired):
                process.wait(10)
            if process.poll() is None:
                process.kill()
                process.wait()
            os.close(our_read)
            os.close(our_write)


def save_screenshot(browser: Browser, path: Path, *, full: bool = False) -> None:
    """Write a picture of the page."""
    path.write_bytes(browser.screenshot(full=full))
