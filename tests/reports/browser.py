"""A headless Chromium, controlled over its debugging pipe: no port is opened and only the file is loaded."""

import base64
import contextlib
import fcntl
import importlib.util
import json
import os
import select
import shutil
import subprocess
import tempfile
import time
from pathlib import Path

CHROMIUM = next((p for n in ("chromium", "chromium-browser", "google-chrome") if (p := shutil.which(n))), None)
WHY_NOT = "there is no Chromium on this machine (apt-get install chromium)"
_AXE = importlib.util.find_spec("axe_core_python")
AXE = None if _AXE is None or _AXE.origin is None else Path(_AXE.origin).parent / "axe.min.js"
_FLAGS = (
    "--headless", "--no-sandbox", "--disable-gpu", "--no-first-run", "--disable-background-networking",
    "--disable-component-update", "--disable-sync", "--disable-extensions", "--disable-dev-shm-usage",
    "--hide-scrollbars", "--force-device-scale-factor=1", "--remote-debugging-pipe",
)  # fmt: skip

#: Drawing in three dimensions without a graphics card, for Rerun.
_WEBGL = ("--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--ignore-gpu-blocklist")


class Browser:
    """One page of a browser; ``messages`` come from its console, ``requests`` are all requested addresses."""

    def __init__(self, width: int = 1280, height: int = 900, *, webgl: bool = False) -> None:
        self._folder = tempfile.TemporaryDirectory(prefix="pdhef-chromium-")
        ours_in, theirs_out = os.pipe()
        theirs_in, ours_out = os.pipe()
        high = [fcntl.fcntl(fd, fcntl.F_DUPFD, 60) for fd in (theirs_in, theirs_out)]  # clear of 3 and 4
        os.close(theirs_in)
        os.close(theirs_out)
        theirs_in, theirs_out = high
        self._in, self._out = ours_in, ours_out
        flags = [f for f in _FLAGS if f != "--disable-gpu"] + list(_WEBGL) if webgl else _FLAGS
        command = [CHROMIUM, *flags, f"--user-data-dir={self._folder.name}", f"--window-size={width},{height}"]
        shell = f'exec "$@" 3<&{theirs_in} 4>&{theirs_out} '
        words = ["bash", "-c", shell, "bash", *command, "about:blank"]
        alone = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL, "start_new_session": True}
        self._process = subprocess.Popen(words, pass_fds=(theirs_in, theirs_out), **alone)
        os.close(theirs_in)
        os.close(theirs_out)
        self._buffer, self._number, self._session = b"", 0, None
        self.messages: list[str] = []
        self.requests: list[str] = []
        self._loaded = False
        targets = self.call("Target.getTargets")["targetInfos"]
        target = next(t["targetId"] for t in targets if t["type"] == "page")
        self._session = self.call("Target.attachToTarget", targetId=target, flatten=True)["sessionId"]
        for domain in ("Page", "Runtime", "Network", "Log"):
            self.call(f"{domain}.enable")
        self.show(width, height)

    def __enter__(self):
        return self

    def __exit__(self, *_: object) -> None:
        with contextlib.suppress(Exception):
            self._session = None
            self.call("Browser.close", wait_s=60.0)
        with contextlib.suppress(subprocess.TimeoutExpired):
            self._process.wait(60.0)
        self._process.kill()
        self._process.wait()
        os.close(self._in)
        os.close(self._out)
        self._folder.cleanup()

    def call(self, method: str, wait_s: float = 180.0, **parameters: object) -> dict:
        self._number += 1
        message = {"id": self._number, "method": method, "params": parameters}
        if self._session is not None:
            message["sessionId"] = self._session
        os.write(self._out, json.dumps(message).encode() + b"\0")
        number, end = self._number, time.monotonic() + wait_s
        while True:
            answer = self._next(end)
            if answer.get("id") == number:
                if "error" in answer:
                    raise RuntimeError(f"{method}: {answer['error']}")
                return answer["result"]

    def _next(self, end: float) -> dict:
        while b"\0" not in self._buffer:
            if not select.select([self._in], [], [], max(0.0, end - time.monotonic()))[0]:
                raise TimeoutError("Chromium says nothing")
            read = os.read(self._in, 1 << 20)
            if not read:
                raise RuntimeError("Chromium has ended")
            self._buffer += read
        text, self._buffer = self._buffer.split(b"\0", 1)
        answer = json.loads(text)
        self._note(answer.get("method"), answer.get("params", {}))
        return answer

    def _note(self, event: str | None, of: dict) -> None:
        if event == "Runtime.consoleAPICalled":
            self.messages.append(" ".join(str(a.get("value", a.get("description"))) for a in of["args"]))
        elif event == "Runtime.exceptionThrown":
            details = of["exceptionDetails"]
            self.messages.append(str(details.get("exception", {}).get("description", details["text"])))
        elif event == "Log.entryAdded":
            self.messages.append(of["entry"]["text"])
        elif event == "Network.requestWillBeSent":
            self.requests.append(of["request"]["url"][:200])
        elif event == "Page.javascriptDialogOpening":
            self.messages.append(f"dialog: {of['message']}")
            self._session and os.write(
                self._out,
                json.dumps({"id": 0, "method": "Page.handleJavaScriptDialog", "params": {"accept": True},
                            "sessionId": self._session}).encode() + b"\0",
            )  # fmt: skip
        elif event == "Page.loadEventFired":
            self._loaded = True

    def show(self, width: int = 1280, height: int = 900, scheme: str = "light") -> None:
        """Set the size of the window and the colour scheme of the user."""
        self.call("Emulation.setDeviceMetricsOverride", width=width, height=height, deviceScaleFactor=1, mobile=False)
        self.call("Emulation.setEmulatedMedia", features=[{"name": "prefers-color-scheme", "value": scheme}])

    def open(self, path: Path | str, wait_s: float = 180.0) -> None:
        """Open a file or an address and wait until all of its figures are drawn."""
        self.messages.clear()
        self.requests.clear()
        self._loaded = False
        end = time.monotonic() + wait_s
        self.call("Page.navigate", url=path if isinstance(path, str) else path.resolve().as_uri())
        while not self._loaded:
            self._next(end)
        self.wait_for("document.documentElement.dataset.drawn !== undefined", end - time.monotonic())

    def wait_for(self, expression: str, wait_s: float = 180.0) -> None:
        """Wait until the expression is true; between two pages it may raise (no document, a context that has gone)."""
        end = time.monotonic() + wait_s
        while True:
            try:
                if self.value(expression):
                    return
                last = "false"
            except RuntimeError as error:
                last = str(error)
            if time.monotonic() > end:
                raise TimeoutError(f"{expression}; {last}; {self.messages}")
            time.sleep(0.02)

    def value(self, expression: str):
        answer = self.call("Runtime.evaluate", expression=expression, awaitPromise=True, returnByValue=True)
        if "exceptionDetails" in answer:
            raise RuntimeError(str(answer["exceptionDetails"]))
        return answer["result"].get("value")

    def screenshot(self, path: Path, *, height: float | None = None) -> None:
        """Take a picture of the whole page, or of its first ``height`` points."""
        size = self.call("Page.getLayoutMetrics")["cssContentSize"]
        tall = size["height"] if height is None else min(height, size["height"])
        clip = {"x": 0, "y": 0, "width": size["width"], "height": tall, "scale": 1}
        made = self.call("Page.captureScreenshot", format="png", captureBeyondViewport=True, clip=clip)
        path.write_bytes(base64.b64decode(made["data"]))

    def drag(self, selector: str, start: float, end: float) -> None:
        """Drag across an element from one share of its width to another."""
        box = self.value(
            f"(() => {{ const n = document.querySelector({selector!r}); n.scrollIntoView({{block: 'center'}});"
            " const b = n.getBoundingClientRect(); return [b.left, b.top + b.height / 2, b.width]; })()"
        )
        for kind, share in (
            ("mouseMoved", start),
            ("mousePressed", start),
            ("mouseMoved", end),
            ("mouseReleased", end),
        ):
            self.call("Input.dispatchMouseEvent", type=kind, x=box[0] + share * box[2], y=box[1], button="left",
                      buttons=int(kind != "mouseReleased"), clickCount=1)  # fmt: skip


def serious(browser: Browser) -> list[str]:
    """Return the serious and critical findings of axe-core (WCAG 2.1 AA), a line an element."""
    browser.value(AXE.read_text(encoding="utf-8") + ";0")
    found = json.loads(browser.value("axe.run(document).then((r) => JSON.stringify(r.violations))"))
    grave = [v for v in found if v["impact"] in ("serious", "critical")]
    return [f"{v['id']}: {node['html'][:80]}: {node['failureSummary']}" for v in grave for node in v["nodes"]]
