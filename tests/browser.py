"""A headless Chromium, told what to do by its debugging protocol."""

from __future__ import annotations

import asyncio
import base64
import json
import os
import shutil
import subprocess
import tempfile
import time
from collections.abc import Coroutine
from pathlib import Path
from typing import Any

import pytest

PROGRAM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome", "chrome"))), None)
_FLAGS = (
    "headless=new", "no-sandbox", "use-angle=swiftshader", "enable-unsafe-swiftshader", "ignore-gpu-blocklist",
    "hide-scrollbars", "remote-debugging-port=0",
)  # fmt: skip


class Browser:
    """One page; what it asked for, logged and threw is kept."""

    def __init__(self, *, width: int = 1280, height: int = 1600, dark: bool = False):
        """Start the program."""
        if PROGRAM is None:
            pytest.skip("there is no Chromium")
        self._folder = tempfile.TemporaryDirectory(prefix="browser-", ignore_cleanup_errors=True)
        place = Path(self._folder.name)
        command = [PROGRAM, *(f"--{flag}" for flag in _FLAGS), f"--user-data-dir={place}", "about:blank"]
        inside = {**os.environ, "TMPDIR": self._folder.name}  # where it makes its own folders
        self._process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, env=inside)
        deadline = time.monotonic() + 60
        port = place / "DevToolsActivePort"
        while not (port.is_file() and len(port.read_text().splitlines()) == 2):
            assert time.monotonic() < deadline, "Chromium did not start"
            time.sleep(0.05)
        number, self._path = port.read_text().splitlines()
        self._loop = asyncio.new_event_loop()
        self._next, self._session = 0, ""
        self.requests: list[str] = []
        self.errors: list[str] = []
        self._do(self._connect(f"ws://127.0.0.1:{number}{self._path}"))
        self.size(width, height, dark=dark)

    def __enter__(self) -> Browser:
        """Return the browser itself."""
        return self

    def __exit__(self, *_: object) -> None:
        """End the program."""
        self._socket.close()
        self._process.terminate()
        self._process.wait(20)
        self._loop.run_until_complete(asyncio.sleep(0))
        self._loop.close()
        self._folder.cleanup()

    def _do(self, work: Coroutine[Any, Any, Any]) -> Any:
        return self._loop.run_until_complete(asyncio.wait_for(work, 90))

    async def _connect(self, address: str) -> None:
        from tornado.websocket import websocket_connect

        self._socket = await websocket_connect(address, max_message_size=1 << 30)
        target = await self._call("Target.createTarget", url="about:blank")
        self._session = (await self._call("Target.attachToTarget", targetId=target["targetId"], flatten=True))["sessionId"]
        for part in ("Page", "Runtime", "Network", "Log"):
            await self._call(f"{part}.enable")

    async def _call(self, method: str, **parameters: Any) -> Any:
        self._next += 1
        message = {"id": self._next, "method": method, "params": parameters}
        await self._socket.write_message(json.dumps({**message, **({"sessionId": self._session} if self._session else {})}))
        while True:
            answer = json.loads(await self._socket.read_message())
            if answer.get("id") == self._next:
                assert "error" not in answer, answer
                return answer["result"]
            self._keep(answer)

    def _keep(self, event: dict[str, Any]) -> None:
        name, what = event.get("method"), event.get("params", {})
        if name == "Network.requestWillBeSent":
            self.requests.append(what["request"]["url"])
        elif name == "Runtime.exceptionThrown":
            thrown = what["exceptionDetails"]
            self.errors.append(str(thrown.get("exception", {}).get("description", thrown["text"])))
        elif name == "Log.entryAdded" and what["entry"]["level"] == "error":
            self.errors.append(f"{what['entry']['text']} {what['entry'].get('url', '')}")

    def size(self, width: int, height: int, *, dark: bool = False) -> None:
        """Set the size of the window, and the scheme of colours."""
        window = {"width": width, "height": height, "deviceScaleFactor": 1, "mobile": width < 600}
        self._do(self._call("Emulation.setDeviceMetricsOverride", **window))
        scheme = [{"name": "prefers-color-scheme", "value": "dark" if dark else "light"}]
        self._do(self._call("Emulation.setEmulatedMedia", features=scheme))

    def open(self, address: str) -> None:
        """Go to a page."""
        self._do(self._call("Page.navigate", url=address))

    def beforehand(self, script: str) -> None:
        """Execute a script in every page that is opened from now on, before its own."""
        self._do(self._call("Page.addScriptToEvaluateOnNewDocument", source=script))

    def ask(self, expression: str) -> Any:
        """Return the value of an expression of JavaScript; a promise is waited for."""
        found = self._do(self._call("Runtime.evaluate", expression=expression, awaitPromise=True, returnByValue=True))
        assert "exceptionDetails" not in found, found["exceptionDetails"]
        return found["result"].get("value")

    def wait(self, condition: str, seconds: float = 60.0) -> None:
        """Wait until an expression is true."""
        deadline = time.monotonic() + seconds
        while not self.ask(f"Boolean({condition})"):
            assert time.monotonic() < deadline, (condition, self.errors)
            time.sleep(0.05)

    def key(self, key: str) -> None:
        """Press a key, such as Tab, Enter or ArrowRight."""
        text = {"Enter": "\r", "Space": " "}.get(key)
        named = {"key": " " if key == "Space" else key, "code": key, **({"text": text} if text else {})}
        code = {"Tab": 9, "Enter": 13, "Space": 32, "ArrowLeft": 37, "ArrowRight": 39}.get(key, 0)
        for kind in ("keyDown", "keyUp"):
            self._do(self._call("Input.dispatchKeyEvent", type=kind, windowsVirtualKeyCode=code, **named))

    def click(self, x: float, y: float) -> None:
        """Click at a place of the window (px), as a mouse does."""
        for kind in ("mousePressed", "mouseReleased"):
            self._do(self._call("Input.dispatchMouseEvent", type=kind, x=x, y=y, button="left", clickCount=1))

    def move(self, x: float, y: float) -> None:
        """Move the mouse to a place of the window (px)."""
        self._do(self._call("Input.dispatchMouseEvent", type="mouseMoved", x=x, y=y))

    def picture(self, file: Path, area: tuple[int, int, int, int] | None = None) -> Path:
        """Write the whole page, or an area of it (left, top, width, height in px), as PNG."""
        clip = {} if area is None else {"clip": {**dict(zip(("x", "y", "width", "height"), area, strict=True)), "scale": 1}}
        found = self._do(self._call("Page.captureScreenshot", format="png", captureBeyondViewport=True, **clip))
        file.write_bytes(base64.b64decode(found["data"]))
        return file
