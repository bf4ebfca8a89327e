"""Walks the built site in a headless Chromium without a network: ``make docs-check``.

It looks for console errors, files that do not load, links and anchors that lead nowhere, formulas and tables that stay
raw, printed numbers that are not rounded, pages wider than their screen, tables and code that are clipped, text that a
picture squeezes, and words that the search does not find. In the sources it looks for code in passing that is not true,
numbers that differ from page to page, paragraphs that begin within a line, and code wider than a page, in docstrings
too. Pictures of pages, at two widths, light and dark, go to ``docs/_build/screenshots``.
"""

from __future__ import annotations

import argparse
import base64
import fcntl
import itertools
import json
import os
import shutil
import subprocess
import sys
import tempfile
import urllib.parse
from collections.abc import Iterator
from contextlib import contextmanager
from fnmatch import fnmatch
from pathlib import Path
from typing import Any

import check_text

HERE = Path(__file__).resolve().parent
HTML = HERE / "_build" / "html"
PICTURES = HTML.parent / "screenshots"
BROWSERS = ("chromium", "chromium-browser", "google-chrome")

WORDS = {
    "Casimir": "casimir",
    "discrete gradient": "gradient",
    "retraction": "retraction",
    "ensemble": "ensemble",
    "MetriplecticGauss": "MetriplecticGauss",
    "friction": "friction",
    "rounding": "rounding",
    "Stiefel": "Stiefel",
    "adaptive": "adaptive",
    "misprint": "misprint",
    "GPU": "engine",
    "GENERIC": "metriplectic",
    "symplectic": "symplectic",
    "torque": "torque",
    "quaternion": "quaternion",
    "density matrix": "density",
    "nutation": "nutation",
    "thermostat": "bath",
    "license": "licence",
    "citation": "citation",
    "roadmap": "roadmap",
    "LLG": "LLG",
    "micromagnetics": "magnet",
    "master equation": "master equation",
    "float32": "install",
    "Toda": "toda",
    "reaction wheel": "spacecraft",
}
"""What a reader looks for, and what a title or an excerpt of the answer holds."""

PICTURED_PAGES = (
    "index",
    "start/index",
    "start/install",
    "start/adopt",
    "start/spacecraft",
    "start/magnets",
    "tutorials/index",
    "tutorials/first_run",
    "howto/index",
    "explanation/index",
    "explanation/accuracy",
    "explanation/large_systems",
    "reference/api",
    "reference/benchmarks",
    "reference/generated/liethermo.integrate",
    "reference/generated/liethermo.LiePoissonSystem",
    "reference/generated/manifolds.LieAlgebra",
    "gallery/index",
)
"""Pages of which screenshots are taken."""

WIDTHS = (1280, 390)

PROBE = """(() => {
  const all = (selector) => [...document.querySelectorAll(selector)];
  const inside = (element) => {
    for (let node = element.parentElement; node && node !== document.body; node = node.parentElement)
      if (["auto", "scroll", "hidden", "clip"].includes(getComputedStyle(node).overflowX)) return true;
    return false;
  };
  const header = document.querySelector(".bd-header .navbar-nav");
  const lines = header ? new Set([...header.children].filter((e) => e.offsetParent).map((e) => e.offsetTop)).size : 0;
  return {
    links: all("a[href]").map((a) => a.href),
    anchors: all("[id]").map((e) => e.id).concat(all("a[name]").map((a) => a.name)),
    images: all("img").map((i) => [
      i.src, i.complete && i.naturalWidth > 0, (i.getAttribute("alt") || "").trim() !== ""]),
    raw: all(".math").filter((e) => !e.querySelector("mjx-container")).map((e) => e.textContent.slice(0, 80)),
    clipped: all(".bd-article table, .bd-article div.highlight pre").filter((e) => {
      const box = e.closest(".pst-scrollable-table-container") || e;
      return Math.max(box.scrollWidth - box.clientWidth, e.scrollWidth - e.clientWidth) > 1;
    }).map((e) => e.tagName + ": " + e.textContent.trim().slice(0, 60)),
    broken: all("mjx-merror").map((e) => e.textContent.slice(0, 80)),
    wide: document.documentElement.scrollWidth - window.innerWidth,
    culprits: all("body *").filter((e) => e.getBoundingClientRect().right > window.innerWidth + 1 && e.offsetParent
      && !inside(e)).slice(0, 3).map((e) => e.tagName + "." + e.className),
    cut: all(".bd-article :is(p, dt, li, h1, h2, h3)").filter((e) => {
      if (!e.offsetParent || e.getBoundingClientRect().right <= document.documentElement.clientWidth + 1) return false;
      for (let node = e.parentElement; node && node !== document.body; node = node.parentElement)
        if (["auto", "scroll"].includes(getComputedStyle(node).overflowX)) return false;
      return true;
    }).map((e) => e.textContent.trim().slice(0, 60)),
    squeezed: all(".bd-article img").filter((e) => e.offsetParent && getComputedStyle(e).float !== "none"
      && e.offsetWidth > document.documentElement.clientWidth / 2).map((e) => e.src),
    headerLines: lines,
    previous: !!document.querySelector(".prev-next-footer a, .prev-next-area a"),
  };
})()"""


class Browser:
    """A Chromium that is driven over a pipe by its own protocol."""

    def __init__(self, program: str, profile: str) -> None:
        to_child, self._out = os.pipe()
        self._in, from_child = os.pipe()
        command = [
            program,
            "--headless=new",
            "--no-sandbox",
            "--disable-gpu",
            "--disable-dev-shm-usage",
            "--allow-file-access-from-files",
            "--host-resolver-rules=MAP * ~NOTFOUND",  # no network: what the site needs must lie in it
            "--remote-debugging-pipe",
            f"--user-data-dir={profile}",
            "about:blank",
        ]
        # Chromium reads from 3 and writes to 4; both may be in use here, so they are set in the new process.
        ends = [fcntl.fcntl(end, fcntl.F_DUPFD_CLOEXEC, 10) for end in (to_child, from_child)]

        def at_three_and_four() -> None:
            for end, number in zip(ends, (3, 4), strict=True):
                os.dup2(end, number)

        self._process = subprocess.Popen(
            command,
            close_fds=False,
            preexec_fn=at_three_and_four,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
        for end in ends:
            os.close(end)
        os.close(to_child)
        os.close(from_child)
        self._buffer, self._numbers, self.events = b"", itertools.count(1), []
        self._session: str | None = None
        target = self.call("Target.createTarget", url="about:blank")["targetId"]
        self._session = self.call("Target.attachToTarget", targetId=target, flatten=True)["sessionId"]
        for domain in ("Page", "Runtime", "Log", "Network"):
            self.call(f"{domain}.enable")

    def _next(self) -> dict[str, Any]:
        while b"\0" not in self._buffer:
            piece = os.read(self._in, 1 << 16)
            if not piece:
                raise RuntimeError("the browser has gone")
            self._buffer += piece
        message, _, self._buffer = self._buffer.partition(b"\0")
        return json.loads(message)

    def call(self, method: str, **parameters: Any) -> dict[str, Any]:
        number = next(self._numbers)
        request: dict[str, Any] = {"id": number, "method": method, "params": parameters}
        if self._session:
            request["sessionId"] = self._session
        os.write(self._out, json.dumps(request).encode() + b"\0")
        while True:
            message = self._next()
            if message.get("id") == number:
                if "error" in message:
                    raise RuntimeError(f"{method}: {message['error']}")
                return message["result"]
            self.events.append(message)

    def evaluate(self, script: str) -> Any:
        answer = self.call("Runtime.evaluate", expression=script, returnByValue=True, awaitPromise=True)
        if "exceptionDetails" in answer:
            raise RuntimeError(answer["exceptionDetails"].get("exception", answer["exceptionDetails"]))
        return answer["result"].get("value")

    def open(self, url: str) -> list[str]:
        """Load a page and wait for its formulas; returns what went wrong."""
        self.events.clear()
        if reason := self.call("Page.navigate", url=url).get("errorText"):
            raise RuntimeError(f"{url}: {reason}")
        while not any(event.get("method") == "Page.loadEventFired" for event in self.events):
            self.events.append(self._next())
        self.evaluate("window.MathJax && MathJax.startup ? MathJax.startup.promise.then(() => 1) : 1")
        return [trouble for event in self.events if (trouble := _trouble(event))]

    def resize(self, width: int, height: int = 900) -> None:
        self.call(
            "Emulation.setDeviceMetricsOverride", width=width, height=height, deviceScaleFactor=1, mobile=width < 500
        )

    def theme(self, name: str) -> None:
        self.evaluate(
            f"document.documentElement.dataset.theme = '{name}'; document.documentElement.dataset.mode = '{name}'"
        )

    def picture(self, file: Path) -> None:
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_bytes(base64.b64decode(self.call("Page.captureScreenshot", format="png")["data"]))

    def close(self) -> None:
        self._session = None
        self.call("Browser.close")
        self._process.wait(timeout=20)


def _trouble(event: dict[str, Any]) -> str | None:
    method, parameters = event.get("method"), event.get("params", {})
    if method == "Runtime.exceptionThrown":
        return f"exception: {parameters['exceptionDetails'].get('exception', {}).get('description', '')[:200]}"
    if method == "Runtime.consoleAPICalled" and parameters["type"] in ("error", "assert"):
        return f"console: {[argument.get('value', argument.get('description')) for argument in parameters['args']]}"
    if method == "Log.entryAdded" and parameters["entry"]["level"] == "error":
        return f"log: {parameters['entry']['text']} {parameters['entry'].get('url', '')}"
    if method == "Network.requestWillBeSent" and parameters["request"]["url"].startswith(("http:", "https:")):
        return f"asks the network for {parameters['request']['url']}"
    return None


@contextmanager
def browser() -> Iterator[Browser]:
    names = (os.environ["CHROMIUM"],) if "CHROMIUM" in os.environ else BROWSERS
    program = next((found for name in names if (found := shutil.which(name))), None)
    if program is None:
        sys.exit("no Chromium was found: apt-get install chromium, or set CHROMIUM to the program of one")
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as profile:
        chromium = Browser(program, profile)
        try:
            yield chromium
        finally:
            chromium.close()


def check_pages(chromium: Browser, html: Path, match: str = "*") -> list[str]:
    """Everything that is wrong with the pages, as lines to print."""
    wrong, anchors, links = [], {}, []
    pages = sorted(page for page in html.rglob("*.html") if "_static" not in page.parts)
    pages = [page for page in pages if fnmatch(str(page.relative_to(html)), match)]
    for page in pages:
        name = str(page.relative_to(html))
        chromium.resize(1280)
        wrong += [f"{name}: {trouble}" for trouble in chromium.open(page.as_uri())]
        chromium.evaluate("document.querySelectorAll('img').forEach((i) => { i.loading = 'eager' })")
        chromium.evaluate("Promise.all([...document.images].map((i) => i.decode().catch(() => 0))).then(() => 1)")
        seen = chromium.evaluate(PROBE)
        anchors[page.resolve()] = set(seen["anchors"])
        links += [(name, link) for link in seen["links"]]
        wrong += [f"{name}: missing image {source}" for source, loaded, _ in seen["images"] if not loaded]
        wrong += [f"{name}: image without words {source}" for source, _, told in seen["images"] if not told]
        wrong += [f"{name}: formula not typeset: {text}" for text in seen["raw"]]
        wrong += [f"{name}: formula in error: {text}" for text in seen["broken"]]
        wrong += [f"{name}: clipped at 1280 pixels: {text}" for text in seen["clipped"]]
        for check in (check_text.raw_tables, check_text.raw_headings, check_text.unrounded_output):
            wrong += [f"{name}: {text}" for text in check(page.read_text())]
        if seen["headerLines"] > 1:
            wrong.append(f"{name}: the header takes {seen['headerLines']} lines")
        chromium.resize(390)
        narrow = chromium.evaluate(PROBE)
        wrong += [f"{name}: cut off at 390 pixels: {text}" for text in narrow["cut"][:3]]
        wrong += [f"{name}: text squeezed beside a picture at 390 pixels: {source}" for source in narrow["squeezed"]]
        if narrow["wide"] > 0:
            wrong.append(f"{name}: {narrow['wide']} pixels wider than 390: {narrow['culprits']}")
    for name, link in sorted(set(links)):
        parts = urllib.parse.urlsplit(link)
        if parts.scheme != "file":
            continue
        target = Path(urllib.parse.unquote(parts.path)).resolve()
        if not target.exists():
            wrong.append(f"{name}: broken link {link}")
        elif parts.fragment and target in anchors and urllib.parse.unquote(parts.fragment) not in anchors[target]:
            wrong.append(f"{name}: broken anchor {link}")
    print(f"{len(pages)} pages, {len(links)} links")
    return wrong


def check_search(chromium: Browser, html: Path) -> list[str]:
    """Words that the search of the site, as it runs in the browser, does not find."""
    wrong = []
    for query, expected in WORDS.items():
        chromium.open((html / "search.html").as_uri() + "?q=" + urllib.parse.quote(query))
        found = chromium.evaluate(
            """new Promise((done) => { let tries = 0, before = -1, alike = 0; const look = () => {
                 const results = [...document.querySelectorAll('#search-results li')].map((e) => e.textContent);
                 alike = results.length && results.length === before ? alike + 1 : 0; // results come one by one
                 before = results.length;
                 if (alike > 10 || ++tries > 100) done(results); else setTimeout(look, 50); };
               look(); })"""
        )
        if not any(expected.casefold() in text.casefold() for text in found):
            wrong.append(f"search: {query!r} finds {len(found)} pages, none about it")
    return wrong


def check_sources(docs: Path) -> list[str]:
    """What the pages say in passing, and the numbers that they share."""
    pages = check_text.sources(docs)
    checks = (check_text.untrue_spans, check_text.differing_numbers, check_text.lost_paragraphs, check_text.wide_code)
    examples = {
        str(file.relative_to(docs.parent)): file.read_text() for file in docs.parent.glob("examples/*/plot_*.py")
    }
    modules = {
        str(file.relative_to(docs.parent)): file.read_text()
        for package in ("liethermo", "manifolds")
        for file in sorted((docs.parent / package).rglob("*.py"))
    }
    problems = [problem for check in checks for problem in check(pages)]
    return [*problems, *check_text.wide_examples(examples), *check_text.wide_docstrings(modules)]


def take_pictures(chromium: Browser, html: Path) -> None:
    for name, width in itertools.product(PICTURED_PAGES, WIDTHS):
        chromium.resize(width)
        chromium.open((html / f"{name}.html").as_uri())
        for theme in ("light", "dark"):
            chromium.theme(theme)
            chromium.evaluate("new Promise((done) => setTimeout(done, 400, 1))")
            chromium.picture(PICTURES / f"{name.replace('/', '-')}-{width}-{theme}.png")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--html", type=Path, default=HTML, help="the built site")
    parser.add_argument("--match", default="*", help="pages to walk, such as 'tutorials/*'; all by default")
    arguments = parser.parse_args()
    html = arguments.html.resolve()
    if not (html / "index.html").is_file():
        sys.exit(f"{html} holds no site; run `make docs` first")
    with browser() as chromium:
        take_pictures(chromium, html)
        wrong = check_pages(chromium, html, arguments.match) + check_search(chromium, html)
        wrong += check_sources(HERE)
    print("\n".join(wrong))
    print(f"{len(wrong)} findings; screenshots in {PICTURES}")
    sys.exit(bool(wrong))


if __name__ == "__main__":
    main()
