"""Frames, charts and pages in a browser, and what is seen in them."""

from __future__ import annotations

import base64
import csv
import io
import json
import os
import select
import shutil
import subprocess
import tempfile
import time
from pathlib import Path
from types import SimpleNamespace

import numpy as np
from PIL import Image

from pfem_petsc.post.camera import direction, fit
from pfem_petsc.post.page import Page
from pfem_petsc.post.render import render
from pfem_petsc.post.scene import Scene

PROGRAM = next(
    (found for name in ("chromium", "chromium-browser", "google-chrome") if (found := shutil.which(name))), None
)
_LIMIT = 60.0  # seconds for an answer


class Browser:
    """A page in a browser without network; ``errors`` are what its console has reported as such."""

    def __init__(self, file: Path, size: tuple[int, int] = (640, 480)) -> None:
        self.errors: list[str] = []
        self.requests: list[str] = []
        self._number, self._rest = 0, b""
        self._profile = tempfile.mkdtemp(prefix="browser-")
        into_read, self._write = os.pipe()
        self._read, out_write = os.pipe()

        def take_pipes() -> None:
            # Chromium reads its orders from 3 and answers on 4
            one, two = os.dup(into_read), os.dup(out_write)
            os.dup2(one, 3)
            os.dup2(two, 4)

        self._process = subprocess.Popen(
            [
                *(PROGRAM, "--headless=new", "--no-sandbox", "--remote-debugging-pipe", "--disable-dev-shm-usage"),
                *("--enable-unsafe-swiftshader", "--use-angle=swiftshader", "--hide-scrollbars", "--no-first-run"),
                *("--host-resolver-rules=MAP * ~NOTFOUND", "--disable-background-networking"),
                *(f"--user-data-dir={self._profile}", f"--window-size={size[0]},{size[1]}"),
            ],
            close_fds=False,
            preexec_fn=take_pipes,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
        os.close(into_read)
        os.close(out_write)
        target = self.ask("Target.createTarget", url="about:blank")["targetId"]
        self._session = self.ask("Target.attachToTarget", targetId=target, flatten=True)["sessionId"]
        for domain in ("Runtime", "Log", "Page", "Network"):
            self.ask(f"{domain}.enable")
        self.ask("Emulation.setDeviceMetricsOverride", width=size[0], height=size[1], deviceScaleFactor=1, mobile=False)
        self.ask("Page.navigate", url=file.absolute().as_uri())
        self.settle()

    def ask(self, method: str, **parameters: object) -> dict:
        """Send an order, and return the answer."""
        self._number += 1
        order = {"id": self._number, "method": method, "params": parameters}
        if hasattr(self, "_session"):
            order["sessionId"] = self._session
        os.write(self._write, json.dumps(order).encode() + b"\0")
        deadline = time.monotonic() + _LIMIT
        while True:
            answer = self._message(deadline - time.monotonic())
            if answer.get("id") == self._number:
                assert "error" not in answer, answer
                return answer["result"]

    def _message(self, seconds: float) -> dict:
        while b"\0" not in self._rest:
            ready, _, _ = select.select([self._read], [], [], max(0.0, seconds))
            part = os.read(self._read, 1 << 20) if ready else b""
            if not part:
                raise TimeoutError("the browser does not answer")
            self._rest += part
        text, _, self._rest = self._rest.partition(b"\0")
        message = json.loads(text)
        name, told = message.get("method"), message.get("params", {})
        if name == "Runtime.exceptionThrown":
            self.errors.append(json.dumps(told["exceptionDetails"]))
        elif name == "Runtime.consoleAPICalled" and told["type"] in ("error", "assert"):
            self.errors.append(json.dumps(told["args"]))
        elif name == "Log.entryAdded" and told["entry"]["level"] == "error":
            self.errors.append(told["entry"]["text"])
        elif name == "Network.requestWillBeSent":
            self.requests.append(told["request"]["url"])
        return message

    def value(self, expression: str) -> object:
        """The value of an expression in the page."""
        asked = {"expression": expression, "returnByValue": True, "awaitPromise": True}
        return self.ask("Runtime.evaluate", **asked)["result"].get("value")

    def settle(self) -> None:
        """Wait until the page is loaded and two frames are drawn."""
        for _ in range(200):
            if self.value("document.readyState") == "complete":
                break
            time.sleep(0.05)
        self.value("new Promise(done => requestAnimationFrame(() => requestAnimationFrame(() => done(1))))")

    def picture(self) -> np.ndarray:
        """The page as it looks (height, width, 3) int."""
        data = base64.b64decode(self.ask("Page.captureScreenshot", format="png")["data"])
        return np.asarray(Image.open(io.BytesIO(data)).convert("RGB")).astype(int)

    def drag(self, start: tuple[int, int], end: tuple[int, int], steps: int = 8) -> None:
        """Press the left button, move, and release it."""
        mouse = {"button": "left", "buttons": 1, "clickCount": 1}
        self.ask("Input.dispatchMouseEvent", type="mousePressed", x=start[0], y=start[1], **mouse)
        for k in range(1, steps + 1):
            x, y = (a + (b - a) * k / steps for a, b in zip(start, end))
            self.ask("Input.dispatchMouseEvent", type="mouseMoved", x=x, y=y, button="left", buttons=1)
        self.ask("Input.dispatchMouseEvent", type="mouseReleased", x=end[0], y=end[1], **mouse)
        self.settle()

    def close(self) -> None:
        self._process.kill()
        self._process.wait()
        os.close(self._write)
        os.close(self._read)
        shutil.rmtree(self._profile, ignore_errors=True)

    def __enter__(self) -> Browser:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def saturated(file) -> np.ndarray:
    """Pixels (n, 3) with a colour: curves, not axes and text."""
    picture = np.asarray(Image.open(file).convert("RGB")).reshape(-1, 3).astype(int)
    return picture[np.ptp(picture, axis=1) > 60]


def table_columns(path):
    head, *rows = csv.reader(path.open())
    return head, np.array(rows, dtype=float).T


TINY = (240, 160)


def draw(folder, result, **options):
    options = {"size": TINY, "video": "none", "poster": False, "note": lambda text: None, **options}
    return render(result, folder, **options)


def pixels(file) -> np.ndarray:
    return np.asarray(Image.open(file).convert("RGBA")).astype(int)


def drawing(file) -> np.ndarray:
    picture = pixels(file)
    left, top, width, height = Page.region_of((picture.shape[1], picture.shape[0]))
    return picture[top : top + height, left : left + width]


def near(picture: np.ndarray, colour, within: int = 40) -> np.ndarray:
    return (np.abs(picture[..., :3] - np.array(colour)).max(axis=2) < within).nonzero()


def box(picture: np.ndarray) -> tuple[int, int, int, int]:
    rows, columns = (picture[..., :3].min(axis=2) < 200).nonzero()
    return rows.min(), rows.max(), columns.min(), columns.max()


def corners(bounds) -> np.ndarray:
    return np.array(np.meshgrid(*np.transpose(bounds))).reshape(3, -1).T


def camera_of(bounds, view="iso", aspect=1.0, normals=()):
    """The camera that has the corners of a box in view."""
    return fit(corners(bounds), direction(view, np.asarray(bounds), normals, (0.0, 0.0, 1.0)), aspect)


def projected(camera, points, size) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Columns and rows [pixels] of points (n, 3) in a picture, and pixels per metre there, 0 behind the eye."""
    away = points - camera.centre
    ahead = np.ones(len(points)) if camera.parallel else 1.0 - away @ camera.towards / camera.distance
    scale = size[1] / (2.0 * camera.half_height) * np.where(ahead > 0.02, 1.0 / np.maximum(ahead, 0.02), 0.0)
    return 0.5 * size[0] + away @ camera.right * scale, 0.5 * size[1] - away @ camera.up * scale, scale


def picture_of(points, bars, colours, camera, size, style, layers=()) -> np.ndarray:
    """Bars without text; layers may be a function of the scene."""
    bounds = np.array([points.min(axis=0), points.max(axis=0)])
    motion = SimpleNamespace(start=points, bars=np.array(bars), bounds=bounds)
    scene = Scene(motion, camera, size, style, unit=min(size[0] / 1110, size[1] / 604))
    added = layers(scene) if callable(layers) else layers
    picture = scene.draw(points, np.array(colours, dtype=np.uint8), camera, layers=added)
    scene.close()
    return picture.astype(int)
