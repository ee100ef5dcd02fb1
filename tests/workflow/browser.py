"""A page in a real browser without a window: what it says on the console, which pictures load, whether it is wider than the screen.

``python tests/workflow/browser.py PAGE ...`` looks at pages that are there.
"""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import threading
from dataclasses import dataclass, field
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import pytest

BROWSER = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
needs_browser = pytest.mark.skipif(BROWSER is None, reason="neither chromium, chromium-browser nor google-chrome is installed")
PHONE, DESK = 390, 1280  # widths of screens, CSS pixels

#: Added to the page: once every picture and film has its size, or none, and the page its layout, tell what there is.
_PROBE = """<script>
addEventListener("load", async () => {
  const posters = [...document.querySelectorAll("video[poster]")].map(film => Object.assign(new Image(), {src: film.poster}));
  const media = [...document.querySelectorAll("img, video"), ...posters];
  await Promise.all(media.map(one => one.decode ? one.decode().catch(() => 0) : one.readyState || one.error || new Promise(done => {
    for (const event of ["loadedmetadata", "error"]) one.addEventListener(event, done);
  })));
  const sizes = media.map(one => [one.tagName, one.naturalWidth || one.videoWidth || 0]);
  fetch("/seen", {method: "POST", body: JSON.stringify({width: document.documentElement.scrollWidth, media: sizes})});
});
</script>"""
#: A window may not be as narrow as a phone, a frame may.
_FRAME = """<!DOCTYPE html><link rel="icon" href="data:,"><iframe width="{width}" height="844" style="border: 0" src="/page"></iframe>"""


@dataclass
class Seen:
    """console: its lines; asked: what the page wanted from elsewhere; width: what it takes [CSS pixels]; media: (tag, its own width in pixels, 0
    if it did not load) of pictures, films and films' posters."""

    console: list[str] = field(default_factory=list)
    asked: list[str] = field(default_factory=list)
    width: int = 0
    media: list[tuple[str, int]] = field(default_factory=list)

    @property
    def faults(self) -> list[str]:
        """What keeps the page from being well, in words."""
        return self.console + [f"asks for {path}" for path in self.asked] + [f"{tag} {n}" for n, (tag, size) in enumerate(self.media) if not size]


def look(page: str, folder: Path, width: int) -> Seen:
    """Open a page that a server of our own hands out, in a screen of some width; folder: for the browser's files."""
    seen, done = Seen(), threading.Event()
    assert page.count("</body>") == 1
    contents = {"/": _FRAME.format(width=width).encode(), "/page": page.replace("</body>", _PROBE + "</body>").encode()}

    class Handler(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            content = contents.get(self.path)
            if content is None:
                seen.asked.append(self.path)
            self.send_response(404 if content is None else 200)
            self.send_header("Content-Type", "text/html; charset=utf-8")
            self.end_headers()
            self.wfile.write(content or b"")

        def do_POST(self) -> None:
            told = json.loads(self.rfile.read(int(self.headers["Content-Length"])))
            seen.width, seen.media = told["width"], [tuple(one) for one in told["media"]]
            self.send_response(204)
            self.end_headers()
            done.set()

        def log_message(self, *_: object) -> None:
            pass

    folder.mkdir(parents=True, exist_ok=True)
    log = folder / "browser.log"
    with ThreadingHTTPServer(("127.0.0.1", 0), Handler) as server, log.open("wb") as output:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        command = [
            BROWSER,
            "--headless",
            "--no-sandbox",
            "--disable-gpu",
            "--disable-extensions",
            "--disable-background-networking",
            "--no-first-run",
            "--hide-scrollbars",
            f"--user-data-dir={folder / 'profile'}",
            "--enable-logging=stderr",
            "--v=0",
            "--window-size=1400,900",
            f"http://127.0.0.1:{server.server_port}/",
        ]
        process = subprocess.Popen(command, stdin=subprocess.DEVNULL, stdout=output, stderr=output, start_new_session=True)
        try:
            assert done.wait(60), f"the browser said nothing: {log.read_text(errors='replace')[-2000:]}"
        finally:
            os.killpg(process.pid, signal.SIGKILL)
            process.wait()
            server.shutdown()
    seen.console = [line for line in log.read_text(errors="replace").splitlines() if ":CONSOLE" in line]
    return seen


def check(page: Path, folder: Path) -> Seen:
    """On a phone and on a desk: nothing on the console, every picture there, nothing from elsewhere, nothing beyond the edge of the screen."""
    for width in (DESK, PHONE):
        seen = look(page.read_text(encoding="utf-8"), folder / f"{page.stem}-{width}", width)
        assert not seen.faults and seen.width <= width, (page, width, seen)
    return seen


if __name__ == "__main__":
    with tempfile.TemporaryDirectory() as place:
        for argument in sys.argv[1:]:
            print(f"{argument}: well, {len(check(Path(argument), Path(place)).media)} pictures and films")
