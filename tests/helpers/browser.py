"""A real browser without a window, driven over its debugging port."""

import base64
import contextlib
import itertools
import json
import os
import shutil
import subprocess
import time
import urllib.request
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from websockets.sync.client import ClientConnection, connect

from waiting import TIMEOUT_S

BROWSERS = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable", "chrome")
FLAGS = (
    "--headless",
    "--no-sandbox",
    "--disable-gpu",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
    "--remote-debugging-port=0",
)


def browser_path() -> str:
    """Path of a browser; skips where there is none, but never in CI."""
    for name in BROWSERS:
        path = shutil.which(name)
        if path:
            return path
    if os.environ.get("CI"):
        pytest.fail("no Chromium: CI must install one")
    return pytest.skip("no Chromium; install one to test the page")


class Page:
    """One page of a browser.

    Attributes
    ----------
    said : list of str
        What its console said.
    """

    def __init__(self, connection: ClientConnection) -> None:
        self.said: list[str] = []
        self._connection = connection
        self._numbers = itertools.count(1)
        self.call("Runtime.enable")
        self.call("Log.enable")
        self.call("Page.enable")

    def call(self, method: str, **parameters: Any) -> dict[str, Any]:
        number = next(self._numbers)
        message = {"id": number, "method": method, "params": parameters}
        self._connection.send(json.dumps(message))
        while True:
            answer = json.loads(self._connection.recv(timeout=TIMEOUT_S))
            if answer.get("id") == number:
                if "error" in answer:
                    raise RuntimeError(answer["error"]["message"])
                return dict(answer["result"])
            self._note(answer)

    def evaluate(self, script: str) -> Any:
        found = self.call("Runtime.evaluate", expression=script, returnByValue=True)
        if "exceptionDetails" in found:
            raise RuntimeError(str(found["exceptionDetails"]))
        return found["result"].get("value")

    def wait_for(self, script: str, seconds: float = TIMEOUT_S) -> Any:
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            # While the page loads, elements that the script looks for are missing.
            with contextlib.suppress(RuntimeError):
                if found := self.evaluate(script):
                    return found
            time.sleep(0.1)
        raise TimeoutError(f"{script}: not within {seconds} s; the console said {self.said}")

    def size(self, width: int, height: int) -> None:
        self.call(
            "Emulation.setDeviceMetricsOverride",
            width=width,
            height=height,
            deviceScaleFactor=1,
            mobile=False,
        )

    def screenshot(self, path: Path) -> None:
        found = self.call("Page.captureScreenshot", format="png")
        path.write_bytes(base64.b64decode(found["data"]))

    def _note(self, event: dict[str, Any]) -> None:
        if event.get("method") == "Runtime.exceptionThrown":
            self.said.append(str(event["params"]["exceptionDetails"]))
        if event.get("method") == "Log.entryAdded":
            self.said.append(str(event["params"]["entry"]["text"]))


@contextlib.contextmanager
def open_page(profile: Path) -> Iterator[Page]:
    """Start a browser with an empty page."""
    browser = subprocess.Popen(
        [browser_path(), *FLAGS, f"--user-data-dir={profile}", "about:blank"],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )
    try:
        port = _wait(lambda: (profile / "DevToolsActivePort").read_text().split()[0])
        address = f"http://127.0.0.1:{port}/json/list"
        pages = _wait(lambda: _pages(address))
        with connect(pages[0]["webSocketDebuggerUrl"], max_size=None) as connection:
            yield Page(connection)
    finally:
        browser.terminate()
        browser.wait(TIMEOUT_S)


def _pages(address: str) -> list[dict[str, Any]]:
    with urllib.request.urlopen(address, timeout=TIMEOUT_S) as answer:
        found = [one for one in json.load(answer) if one["type"] == "page"]
    if not found:
        raise OSError("no page yet")
    return found


def _wait(look: Callable[[], Any]) -> Any:
    end = time.monotonic() + TIMEOUT_S
    while True:
        try:
            return look()
        except (OSError, IndexError):
            if time.monotonic() > end:
                raise
            time.sleep(0.1)
