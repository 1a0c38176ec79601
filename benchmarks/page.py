"""How fast the web page appears, how large it is, and how fast a large surface plays in it.

    python -m benchmarks.page [--points 100000] [--frames 60]

Needs the built page (make page), Playwright and a Chromium; pictures are drawn by the processor
(SwiftShader), as on a machine without a graphics card. Prints a table in Markdown.
"""

from __future__ import annotations

import argparse
import gzip
import math
import os
import statistics
import sys
import tempfile
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from playwright.sync_api import sync_playwright

from service.routes.page import BUILT
from smsr.synthetic import make_example
from smsr_client import Client, require_success
from tests.browser.conftest import FLAGS, find_chromium
from tests.conftest import clean_environment, serving

if TYPE_CHECKING:
    from playwright.sync_api import Browser, Page

_FIRST_PAINT = """() => new Promise((done) => {
    const found = performance.getEntriesByName("first-contentful-paint")[0];
    if (found) return done(found.startTime);
    new PerformanceObserver((list) => done(list.getEntriesByName("first-contentful-paint")[0]
        .startTime)).observe({ type: "paint", buffered: true });
})"""

_PICTURES = """(seconds) => new Promise((done) => {
    const start = performance.now();
    let pictures = -1;
    const next = (now) => {
        pictures += 1;
        if (now - start > 1000 * seconds) done((1000 * pictures) / (now - start));
        else requestAnimationFrame(next);
    };
    requestAnimationFrame(next);
})"""


def sizes() -> list[tuple[str, int]]:
    """Return the compressed sizes of the page's parts, three.js apart."""
    found = {"three.js": 0, "the page": 0}
    for path in sorted(BUILT.rglob("*")):
        if path.suffix in (".js", ".css", ".html", ".svg"):
            part = "three.js" if path.name.startswith("three-") else "the page"
            found[part] += len(gzip.compress(path.read_bytes(), mtime=0))
    return list(found.items())


def first_paints(browser: Browser, url: str, times: int) -> list[float]:
    """Return milliseconds to the first contentful paint, with an empty cache each time."""
    found = []
    for _ in range(times):
        context = browser.new_context(viewport={"width": 1360, "height": 860})
        page = context.new_page()
        page.goto(url)
        found.append(float(page.evaluate(_FIRST_PAINT)))
        context.close()
    return found


def submit_large(url: str, points: int, frames: int) -> tuple[str, int]:
    """Reconstruct a generated sequence; return the id of its job and the number of points."""
    side = round(math.sqrt(points))
    example = make_example(frames=frames, side=side)
    with tempfile.TemporaryDirectory() as folder, Client(url) as client:
        measurements, faces = Path(folder, "tracks.npy"), Path(folder, "faces.npy")
        np.save(measurements, example.measurements.astype(np.float32))
        np.save(faces, example.faces)
        job = client.submit(measurements, faces=faces)
        require_success(client.wait(job.id))
        return job.id, side * side


def playing(page: Page, *, mesh: bool, whole: bool, seconds: float) -> dict[str, Any]:
    """Play for a while; return pictures a second and the points that each of them showed."""
    page.set_checked("#mesh", mesh)
    page.set_checked("#whole", whole)
    page.wait_for_timeout(6000)  # buffers are filled in the first round
    rate = float(page.evaluate(_PICTURES, seconds))
    drawn = int(page.locator(".surface").get_attribute("data-drawn") or 0)
    return {"rate": rate, "drawn": drawn}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--points", type=int, default=100_000)
    parser.add_argument("--frames", type=int, default=60)
    parser.add_argument("--seconds", type=float, default=4.0)
    arguments = parser.parse_args()
    chromium = find_chromium()
    if chromium is None or not (BUILT / "index.html").is_file():
        sys.exit("needs Chromium and the built page (make page)")

    with (
        tempfile.TemporaryDirectory() as folder,
        serving(Path(folder), "--workers", "1", environment=clean_environment()) as server,
        sync_playwright() as playwright,
    ):
        browser = playwright.chromium.launch(executable_path=chromium, args=FLAGS)
        print(f"Chromium {browser.version}, {os.cpu_count()} processors, load {os.getloadavg()[0]}")
        for part, size in sizes():
            print(f"- {part}: {size / 1000:.1f} kB gzip")
        paints = first_paints(browser, server.url, 5)
        print(f"- first contentful paint: {statistics.median(paints):.0f} ms (of 5)")
        job, points = submit_large(server.url, arguments.points, arguments.frames)
        page = browser.new_page(viewport={"width": 1360, "height": 860})
        page.set_default_timeout(300_000)
        started = time.monotonic()
        page.goto(f"{server.url}/#/jobs/{job}")
        page.wait_for_selector(".viewer[data-loaded]")
        print(
            f"- {points:,} points, {arguments.frames} frames: {time.monotonic() - started:.1f} s "
            "until all are in the viewer"
        )
        page.wait_for_selector(".viewer[data-complete]")
        print("\n| drawn | points | pictures/s |\n|---|---:|---:|")
        for name, options in {
            "points, as many as 30 pictures/s allow": {"mesh": False, "whole": False},
            "points, all": {"mesh": False, "whole": True},
            "shaded mesh, all": {"mesh": True, "whole": True},
        }.items():
            found = playing(page, seconds=arguments.seconds, **options)
            print(f"| {name} | {found['drawn']:,} | {found['rate']:.0f} |")
        browser.close()


if __name__ == "__main__":
    main()
