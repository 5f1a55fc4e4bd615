"""A headless Chromium for tests and pictures, driven by the DevTools protocol over pipes."""

import base64
import json
import os
import select
import shutil
import subprocess
import time

_NAMES = "chromium", "chromium-browser", "google-chrome"
PROGRAM = next(filter(None, map(shutil.which, _NAMES)), None)
_SECONDS = 30  # after which an answer is no longer expected

OPTIONS = (
    "--headless=new", "--no-sandbox", "--disable-gpu", "--no-first-run", "--hide-scrollbars",
    "--disable-background-networking", "--disable-component-update", "--disable-sync",
    "--disable-dev-shm-usage", "--force-device-scale-factor=1", "--remote-debugging-pipe",
)  # fmt: skip


class Chromium:
    """One page of a browser that runs within a `with` block.

    Parameters
    ----------
    profile : Path
        Folder for the browser's own files.

    Attributes
    ----------
    errors : list
        Errors of the page, and addresses that it has requested from a network.
    """

    def __init__(self, profile):
        self._profile = profile
        self._number, self._session, self._rest, self.errors = 0, None, b"", []

    def __enter__(self):
        """Start the browser, and open an empty page."""
        theirs_in, self._to = os.pipe()
        self._from, theirs_out = os.pipe()
        # The protocol's pipes are descriptors 3 and 4 of the browser.
        arguments = " ".join((*OPTIONS, f"'--user-data-dir={self._profile}'"))
        command = f"exec {PROGRAM} {arguments} 3<&{theirs_in} 4>&{theirs_out}"
        self._process = subprocess.Popen(
            ["bash", "-c", command],
            pass_fds=(theirs_in, theirs_out), stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
        )  # fmt: skip
        os.close(theirs_in)
        os.close(theirs_out)
        target = self.call("Target.createTarget", url="about:blank")["targetId"]
        attached = self.call("Target.attachToTarget", targetId=target, flatten=True)
        self._session = attached["sessionId"]
        for domain in ("Page", "Runtime", "Log", "Network"):
            self.call(f"{domain}.enable")
        return self

    def __exit__(self, *_):
        """End the browser."""
        os.close(self._to)  # upon which the browser ends
        os.close(self._from)
        try:
            self._process.wait(10)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()

    def call(self, method, **parameters):
        """Return the result of a command of the protocol."""
        self._number += 1
        message = {"id": self._number, "method": method, "params": parameters}
        if self._session:
            message["sessionId"] = self._session
        os.write(self._to, json.dumps(message).encode() + b"\0")
        end = time.monotonic() + _SECONDS
        while True:
            answer = self._answer(end)
            if answer.get("id") == self._number:
                assert "error" not in answer, answer["error"]
                return answer["result"]
            self._note(answer)

    def _note(self, event):
        """Keep errors of the page, and whatever it asks a network for."""
        method, parameters = event.get("method"), event.get("params", {})
        if method == "Runtime.exceptionThrown":
            self.errors.append(parameters["exceptionDetails"])
        elif method == "Log.entryAdded" and parameters["entry"]["level"] == "error":
            self.errors.append(parameters["entry"])
        elif method == "Network.requestWillBeSent":
            url = parameters["request"]["url"]
            if not url.startswith(("file:", "data:", "blob:", "about:")):
                self.errors.append(url)

    def _answer(self, end):
        while b"\0" not in self._rest:
            ready, *_ = select.select([self._from], [], [], max(end - time.monotonic(), 0))
            assert ready, "the browser does not answer"
            part = os.read(self._from, 1 << 20)
            assert part, "the browser has ended"
            self._rest += part
        answer, _, self._rest = self._rest.partition(b"\0")
        return json.loads(answer)

    def open(self, path, width=1200, height=800, address=""):
        """Open a page from the disk, and wait until it has drawn all tiles in view."""
        self.call(
            "Emulation.setDeviceMetricsOverride",
            width=width, height=height, deviceScaleFactor=1, mobile=False,
        )  # fmt: skip
        self.call("Page.navigate", url="about:blank")
        self.call("Page.navigate", url=f"{path.resolve().as_uri()}{address}")
        self.wait_until("document.readyState === 'complete'")
        self.settle()

    def settle(self):
        """Wait until every tile in view has been drawn."""
        frames = "new Promise(done => requestAnimationFrame(() => requestAnimationFrame(done)))"
        self.js(f"{frames}.then(() => 0)")
        self.wait_until("document.body.dataset.loading === '0'")
        self.js(f"{frames}.then(() => 0)")

    def wait_until(self, condition):
        """Wait until an expression is true."""
        end = time.monotonic() + _SECONDS
        while not self.js(f"Boolean({condition})"):
            assert time.monotonic() < end, condition
            time.sleep(0.02)

    def js(self, expression):
        """Return the value of an expression, or what a promise leads to."""
        found = self.call(
            "Runtime.evaluate", expression=expression, returnByValue=True, awaitPromise=True
        )
        assert "exceptionDetails" not in found, found
        return found["result"].get("value")

    def text(self, selector):
        """Return the text of the first element that a selector finds."""
        return self.js(f"document.querySelector({selector!r}).textContent")

    def move(self, x, y):
        """Move the mouse to a place."""
        self.call("Input.dispatchMouseEvent", type="mouseMoved", x=x, y=y)
        self.settle()

    def click(self, x, y):
        """Click at a place."""
        for kind in ("mouseMoved", "mousePressed", "mouseReleased"):
            button = {} if kind == "mouseMoved" else {"button": "left", "clickCount": 1}
            self.call("Input.dispatchMouseEvent", type=kind, x=x, y=y, **button)
        self.settle()

    def press(self, key):
        """Press a key that has a name, or types a letter."""
        text = {"text": key} if len(key) == 1 else {}
        if key == "Enter":
            text = {"text": "\r"}
        self.call("Input.dispatchKeyEvent", type="keyDown", key=key, **text)
        self.call("Input.dispatchKeyEvent", type="keyUp", key=key)
        self.settle()

    def type(self, text):
        """Type a text into the element that has the focus."""
        self.call("Input.insertText", text=text)

    def screenshot(self):
        """Return a picture of the page, as the bytes of a PNG."""
        return base64.b64decode(self.call("Page.captureScreenshot", format="png")["data"])
