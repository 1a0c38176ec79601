"""The web page as people use it, in a real browser against a real server and worker."""

from __future__ import annotations

import base64
import contextlib
import io
import json
import re
import zipfile
from typing import TYPE_CHECKING, Any

import httpx
import numpy as np
import pytest
from playwright.sync_api import expect

from smsr.synthetic import make_example
from tests.browser.conftest import FLAGS, PATIENCE, find_chromium, visiting
from tests.conftest import ROOT, redis_running
from tests.service.conftest import api_running, finished, npy, settings_for
from worker.keys import KeyStore
from worker.pool import WorkerPool

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    from playwright.sync_api import Browser, Locator, Page

    from tests.browser.conftest import Visit
    from tests.service.conftest import Api

pytestmark = [pytest.mark.browser, pytest.mark.slow]

AXE = ROOT / "service" / "page" / "node_modules" / "axe-core" / "axe.min.js"


@pytest.fixture(scope="module", autouse=True)
def patience() -> Iterator[None]:
    expect.set_options(timeout=PATIENCE)
    yield
    expect.set_options(timeout=5000)


@pytest.fixture(scope="module")
def files() -> dict[str, bytes]:
    example = make_example(frames=30, side=20)
    return {
        "tracks.npy": npy(example.measurements.astype(np.float32)),
        "truth_gt.npy": npy(example.ground_truth.astype(np.float32)),
        "faces.npy": npy(example.faces),
    }


@pytest.fixture(scope="module")
def job(site: Api, files: dict[str, bytes]) -> dict[str, Any]:
    """A job with ground truth and faces that has succeeded."""
    sent = {
        "measurements": ("tracks.npy", files["tracks.npy"]),
        "ground_truth": ("truth_gt.npy", files["truth_gt.npy"]),
        "faces": ("faces.npy", files["faces.npy"]),
    }
    with site.client() as client:
        done = finished(client, client.post("/v1/jobs", files=sent))
    assert done["status"] == "succeeded", done
    return done


def drop(page: Page, files: dict[str, bytes]) -> None:
    """Drop files on the page, as from a file manager."""
    contents = {name: base64.b64encode(content).decode() for name, content in files.items()}
    transfer = page.evaluate_handle(
        """(contents) => {
            const transfer = new DataTransfer();
            for (const [name, content] of Object.entries(contents)) {
                const bytes = Uint8Array.from(atob(content), (c) => c.charCodeAt(0));
                transfer.items.add(new File([bytes], name));
            }
            return transfer;
        }""",
        contents,
    )
    for event in ("dragenter", "dragover", "drop"):
        page.dispatch_event("[data-drop]", event, {"dataTransfer": transfer})


def viewer_of(visit: Visit, job: dict[str, Any]) -> Page:
    """Open the viewer of a job, and wait until all is there."""
    page = visit.open(f"/#/jobs/{job['id']}")
    page.wait_for_selector(".viewer[data-complete]")
    return page


def still_viewer_of(visit: Visit, job: dict[str, Any]) -> Page:
    """Open the viewer of a job for someone who asked for no motion: nothing plays by itself."""
    visit.page.emulate_media(reduced_motion="reduce")
    return viewer_of(visit, job)


def picture(page: Page, selector: str = ".surface") -> bytes:
    """Return the pixels of an element, once what was asked to be drawn has been."""
    page.evaluate(
        "() => new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(done)))"
    )
    return page.locator(selector).screenshot()


def pixels(page: Page, selector: str = ".surface") -> Any:
    """Return how many pixels of a canvas are not empty, and their mean colour."""
    return page.evaluate(
        """async ([selector, encoded]) => {
            const bytes = Uint8Array.from(atob(encoded), (c) => c.charCodeAt(0));
            const picture = await createImageBitmap(new Blob([bytes]));
            const canvas = new OffscreenCanvas(picture.width, picture.height);
            const context = canvas.getContext("2d");
            context.drawImage(picture, 0, 0);
            const { data } = context.getImageData(0, 0, canvas.width, canvas.height);
            let bright = 0;
            for (let i = 0; i < data.length; i += 4) {
                if (data[i] + data[i + 1] + data[i + 2] > 240) bright += 1;
            }
            return bright;
        }""",
        [selector, base64.b64encode(picture(page, selector)).decode()],
    )


def frame_of(page: Page) -> str | None:
    return page.locator(".viewer").get_attribute("data-frame")


def test_dropped_files_become_a_surface(visit: Visit, files: dict[str, bytes]) -> None:
    page = visit.page
    page.add_init_script(
        """window.seen = [];
        new MutationObserver(() => {
            for (const part of document.querySelectorAll(".stage-name, .percent, .badge")) {
                if (part.textContent) window.seen.push(part.textContent);
            }
        }).observe(document, { childList: true, subtree: true, characterData: true });"""
    )
    visit.open()
    drop(page, files)
    rows = page.locator(".files li")
    expect(rows).to_have_count(3)
    roles = {
        row.locator("strong").inner_text(): row.locator("select").input_value()
        for row in rows.all()
    }
    assert roles == {
        "tracks.npy": "measurements",
        "truth_gt.npy": "ground_truth",
        "faces.npy": "faces",
    }
    expect(rows.filter(has_text="tracks.npy")).to_contain_text("30 frames of 400 points")
    assert pixels(page, ".preview canvas") > 400, "the tracks are shown before they are sent"

    page.get_by_role("button", name="Send").click()
    page.wait_for_selector(".viewer[data-complete]")
    seen = page.evaluate("window.seen")
    assert any(re.fullmatch(r"\d+ %|Running.*|Waiting.*|A worker.*", text) for text in seen), seen
    assert pixels(page) > 2000
    shown = page.locator(".e3d").inner_text()
    job = httpx.get(f"{visit.api.url}/v1/jobs/{page.url.rpartition('/')[2]}").json()
    assert float(shown) == pytest.approx(job["metrics"]["e3d"], rel=5e-3)


def test_options_are_sent_where_they_differ(
    visit: Visit, files: dict[str, bytes], tmp_path: Path
) -> None:
    page = visit.open()
    chosen = tmp_path / "w.npy"
    chosen.write_bytes(files["tracks.npy"])
    page.set_input_files("#files", chosen)
    page.get_by_label("Camera model").select_option("relaxed")
    page.get_by_text("More options").click()
    page.get_by_label("Basis size").fill("4")
    page.get_by_role("button", name="Send").click()
    page.wait_for_selector(".viewer[data-loaded]")
    job = httpx.get(f"{visit.api.url}/v1/jobs/{page.url.rpartition('/')[2]}").json()
    assert (job["options"]["camera_model"], job["options"]["basis_size"]) == ("relaxed", 4)
    assert job["options"]["shape_iterations"] == 1000


def test_the_surface_moves_and_time_can_be_scrubbed(visit: Visit, job: dict[str, Any]) -> None:
    page = viewer_of(visit, job)
    playing = page.get_by_role("button", name="Pause")
    expect(playing).to_be_visible()  # it plays by itself
    first = frame_of(page)
    page.wait_for_function(
        "(f) => document.querySelector('.viewer').dataset.frame !== f", arg=first
    )
    playing.click()
    page.locator(".scrub").fill("0")
    start = picture(page)
    assert start == picture(page), "a paused picture stands still"
    page.locator(".scrub").fill("15")
    assert frame_of(page) == "15"
    assert page.locator(".frame-label").inner_text() == "16 / 30"
    assert picture(page) != start
    tracks = picture(page, ".stage-2d canvas")
    page.get_by_role("button", name="Frame on").click()
    assert frame_of(page) == "16"
    assert picture(page, ".stage-2d canvas") != tracks


def test_each_colouring_is_another_picture_with_a_legend(visit: Visit, job: dict[str, Any]) -> None:
    page = still_viewer_of(visit, job)
    page.locator(".scrub").fill("10")
    seen: dict[str, bytes] = {}
    for name, legend in {
        "depth": "Depth",
        "motion": "3D motion",
        "error": "ground truth",
        "plain": None,
    }.items():
        page.select_option("#colour", name)
        if legend is None:
            expect(page.locator(".legend")).to_be_hidden()
        else:
            expect(page.locator(".legend")).to_contain_text(legend)
            assert page.locator(".legend .tick").count() >= 2
        page.uncheck("#mesh")
        seen[f"{name} points"] = picture(page)
        page.check("#mesh")
        seen[f"{name} mesh"] = picture(page)
    assert len(set(seen.values())) == len(seen)


def test_errors_of_the_page_are_those_of_the_service(visit: Visit, job: dict[str, Any]) -> None:
    """The page aligns the ground truth on its own, as smsr.metrics does."""
    page = still_viewer_of(visit, job)
    found = json.loads(page.locator(".viewer").get_attribute("data-errors") or "[]")
    assert found == pytest.approx(job["metrics"]["per_frame"], abs=2e-5)
    expect(page.locator(".error-plot path.plot-line")).to_be_visible()
    without = picture(page)
    page.check("#truth")
    assert picture(page) != without


def test_points_without_faces_can_be_triangulated(
    visit: Visit, site: Api, files: dict[str, bytes]
) -> None:
    with site.client() as client:
        sent = client.post("/v1/jobs", files={"measurements": ("w.npy", files["tracks.npy"])})
        done = finished(client, sent)
    page = still_viewer_of(visit, done)
    cloud = pixels(page)
    expect(page.locator("#mesh")).to_be_disabled()
    page.check("#triangulate")
    expect(page.locator("#mesh")).to_be_checked()
    expect(page.locator(".stage-note")).to_contain_text("triangulation")
    assert pixels(page) > cloud


def test_the_view_turns_and_the_cameras_are_shown(visit: Visit, job: dict[str, Any]) -> None:
    page = still_viewer_of(visit, job)
    front = picture(page)
    box = page.locator(".surface").bounding_box()
    assert box is not None
    x, y = box["x"] + box["width"] / 2, box["y"] + box["height"] / 2
    page.mouse.move(x, y)
    page.mouse.down()
    page.mouse.move(x + 150, y + 40, steps=4)
    page.mouse.up()
    assert picture(page) != front
    page.get_by_role("button", name="Reset the view").click()
    page.wait_for_timeout(300)
    for box_id in ("#path", "#follow"):
        before = picture(page)
        page.check(box_id)
        assert picture(page) != before, box_id
        page.uncheck(box_id)


def test_downloads_are_the_bytes_of_the_api(
    visit: Visit, job: dict[str, Any], tmp_path: Path
) -> None:
    page = still_viewer_of(visit, job)
    page.locator(".scrub").fill("7")
    links = job["links"]
    wanted = {
        ".npz": links["result"],
        "-frames.zip": links["frames"],
        "-frame-0007.ply": links["frame"].replace("{t}", "7"),
        "-report.json": links["report"],
    }
    buttons = page.locator(".downloads button")
    for button in buttons.all():
        with page.expect_download() as download:
            button.click()
        name = download.value.suggested_filename
        suffix = next((end for end in wanted if name.endswith(end)), None)
        if suffix is None:
            assert name.endswith(".glb"), name  # test_the_view_stands_upright
            continue
        download.value.save_as(tmp_path / name)
        assert (tmp_path / name).read_bytes() == httpx.get(
            visit.api.url + wanted.pop(suffix)
        ).content
    assert wanted == {}
    arrays = np.load(next(tmp_path.glob("*.npz")))
    assert arrays["shapes"].shape == (30, 400, 3)


def test_the_view_stands_upright(visit: Visit, job: dict[str, Any], tmp_path: Path) -> None:
    """Pixels count from the top; who has other tracks turns the view, and what is made of it."""
    page = still_viewer_of(visit, job)
    expect(page.locator("#up")).not_to_be_checked()
    page.locator(".scrub").fill("5")
    before = picture(page), picture(page, ".stage-2d canvas")
    page.check("#up")
    assert picture(page) != before[0]
    assert picture(page, ".stage-2d canvas") != before[1]
    with page.expect_download() as download:
        page.get_by_role("button", name="GLB").click()
    download.value.save_as(tmp_path / "up.glb")
    given = {
        v: httpx.get(visit.api.url + job["links"]["glb"], params={"image_v": v}).content
        for v in ("auto", "up", "down")
    }
    assert (tmp_path / "up.glb").read_bytes() == given["up"] != given["down"] == given["auto"]
    page.uncheck("#up")
    page.evaluate("scrollTo(0, 0)")  # else the same pixels lie between others
    page.wait_for_timeout(300)
    assert (picture(page), picture(page, ".stage-2d canvas")) == before


def test_figures_are_drawn_when_they_are_wanted(
    visit: Visit, job: dict[str, Any], tmp_path: Path
) -> None:
    page = still_viewer_of(visit, job)
    assert page.locator(".figures canvas").count() == 0
    page.get_by_text("Figures", exact=True).click()
    expect(page.locator(".figures canvas")).to_have_count(5)
    assert pixels(page, ".figures canvas >> nth=0") > 10_000
    with page.expect_download() as download:
        page.get_by_role("button", name="Error of each frame, SVG").click()
    download.value.save_as(tmp_path / "error.svg")
    address = job["links"]["figure"].format(name="error", form="svg")
    assert (tmp_path / "error.svg").read_bytes() == httpx.get(visit.api.url + address).content


def test_several_sequences_become_a_batch(
    visit: Visit, files: dict[str, bytes], tmp_path: Path
) -> None:
    page = visit.open()
    drop(page, {"one.npy": files["tracks.npy"], "two.npy": files["tracks.npy"]})
    expect(page.locator(".hint")).to_contain_text("2 jobs")
    page.get_by_label("Batch").fill("pair-1")
    page.get_by_label("Priority").select_option("high")
    page.get_by_role("button", name="Send").click()
    expect(page.get_by_role("heading", name="Batch pair-1")).to_be_visible()
    expect(page.locator(".batch")).to_contain_text("2: 2 done")
    expect(page.locator("tbody tr")).to_have_count(2)
    jobs = httpx.get(f"{visit.api.url}/v1/jobs", params={"batch": "pair-1"}).json()["jobs"]
    assert {(job["name"], job["priority"]) for job in jobs} == {
        ("one.npy", "high"),
        ("two.npy", "high"),
    }
    with page.expect_download() as download:
        page.get_by_role("button", name="Results as ZIP").click()
    download.value.save_as(tmp_path / "pair.zip")
    with zipfile.ZipFile(tmp_path / "pair.zip") as archive:
        assert sum(name.endswith("result.npz") for name in archive.namelist()) == 2
    visit.open("/#/jobs")
    page.get_by_role("link", name="pair-1").first.click()
    visit.refusals_expected = True  # the batch is looked for once it is gone
    page.get_by_role("button", name="Delete all").click()
    page.get_by_role("dialog").get_by_role("button", name="Delete").click()
    expect(page.locator(".notice")).to_contain_text("No job of this batch is left")
    expect(page.locator("tbody tr")).to_have_count(0)


def test_what_will_not_fit_is_said_before_it_is_sent(visit: Visit, files: dict[str, bytes]) -> None:
    W = np.load(io.BytesIO(files["tracks.npy"]))
    gaps = W.copy()
    gaps[10:12, ::5] = np.nan
    page = visit.open()
    drop(page, {"gaps.npy": npy(gaps), "truth.npy": npy(np.zeros((30, 7, 3)))})
    expect(page.locator(".files")).to_contain_text("T = 30 and N = 400")
    page.get_by_role("button", name="Remove truth.npy").click()
    note = page.locator(".preview .note")
    expect(note).to_contain_text("0.67 % of the positions are not seen")
    page.get_by_label("Missing").select_option("complete")
    expect(note).to_be_hidden()
    page.get_by_role("button", name="Send").click()
    page.wait_for_selector(".viewer[data-complete]")
    page = visit.open()
    page.reload()
    drop(page, {"odd.npy": npy(W[:-1])})
    expect(page.locator(".files .note")).to_contain_text("no tracks")


def test_the_page_goes_on_when_the_service_is_back(
    browser: Browser,
    page_built: Path,
    files: dict[str, bytes],
    tmp_path_factory: pytest.TempPathFactory,
) -> None:
    assert page_built.is_dir()
    folder = tmp_path_factory.mktemp("away")
    with contextlib.ExitStack() as stack:
        redis = stack.enter_context(redis_running(folder))
        settings = settings_for(folder, redis)
        first = contextlib.ExitStack()
        api = first.enter_context(api_running(settings, redis, folder / "api.log"))
        visit = stack.enter_context(visiting(browser, api))
        visit.refusals_expected = True
        with first:
            page = visit.open()
            drop(page, {"tracks.npy": files["tracks.npy"]})
            page.get_by_role("button", name="Send").click()
            expect(page.locator(".stage-name")).to_contain_text("Waiting")
            expect(page.locator("#away")).to_be_hidden()
        expect(page.locator("#away")).to_contain_text("does not answer")
        port = int(api.url.rpartition(":")[2])
        stack.enter_context(api_running(settings, redis, folder / "again.log", port))
        expect(page.locator("#away")).to_be_hidden()
        stack.enter_context(WorkerPool(settings, 1))
        page.wait_for_selector(".viewer[data-complete]")


def test_a_large_upload_goes_on_where_it_broke(
    browser: Browser, page_built: Path, tmp_path_factory: pytest.TempPathFactory
) -> None:
    assert page_built.is_dir()
    folder = tmp_path_factory.mktemp("large")
    example = make_example(frames=20, side=460)
    np.save(folder / "large.npy", example.measurements)
    assert (folder / "large.npy").stat().st_size > 64e6
    with contextlib.ExitStack() as stack:
        redis = stack.enter_context(redis_running(folder))
        settings = settings_for(folder, redis, max_upload_bytes=2**30, max_array_bytes=2**30)
        crashing = stack.enter_context(api_running(settings, redis, folder / "api.log"))
        visit = stack.enter_context(visiting(browser, crashing))
        visit.refusals_expected = True
        offsets: list[int] = []
        visit.page.on(
            "request",
            lambda request: (
                offsets.append(int(request.headers["upload-offset"]))
                if request.method == "PATCH"
                else None
            ),
        )
        page = visit.open()
        page.set_input_files("#files", folder / "large.npy")
        page.context.new_cdp_session(page).send(
            "Network.emulateNetworkConditions",
            {"offline": False, "latency": 0, "downloadThroughput": -1, "uploadThroughput": 2e7},
        )
        page.get_by_role("button", name="Send").click()
        percent = page.locator(".sending span")
        expect(percent).to_have_text(re.compile(r"^[2-9]\d %"))
        crashing.process.kill()
        expect(page.locator("#away")).to_be_visible()
        port = int(crashing.url.rpartition(":")[2])
        stack.enter_context(api_running(settings, redis, folder / "again.log", port))
        stack.enter_context(WorkerPool(settings, 1))
        page.wait_for_selector(".viewer[data-loaded]")
        assert offsets[0] == 0
        assert offsets[-1] > 5e6
        job = httpx.get(f"{crashing.url}/v1/jobs/{page.url.rpartition('/')[2]}").json()
        sent = httpx.get(crashing.url + job["inputs"]["measurements"]["link"]).content
        assert sent == (folder / "large.npy").read_bytes()


def test_a_file_that_is_none_is_refused_in_words(visit: Visit) -> None:
    visit.refusals_expected = True
    page = visit.open()
    drop(page, {"tracks.npy": b"this is no array of numbers, whatever its name says"})
    page.get_by_role("button", name="Send").click()
    alert = page.get_by_role("alert")
    expect(alert.get_by_role("heading")).to_be_visible()
    expect(alert).to_contain_text("What helps:")
    link = alert.get_by_role("link", name="About this problem")
    with page.expect_popup() if link.get_attribute("target") else page.expect_navigation():
        link.click()
    assert "/problems/" in page.url
    expect(page.locator("body")).to_contain_text(re.compile("remed|help|Send|Write", re.I))


def test_a_job_that_fails_says_why(visit: Visit, site: Api) -> None:
    example = make_example(frames=10, side=5)
    W = example.measurements.astype(np.float32)
    W[3, 20] = np.nan
    with site.client() as client:
        done = finished(client, client.post("/v1/jobs", files={"measurements": ("w.npy", npy(W))}))
    assert done["status"] == "failed"
    page = visit.open(f"/#/jobs/{done['id']}")
    alert = page.get_by_role("alert")
    expect(alert).to_contain_text(done["problem"]["title"])
    expect(alert).to_contain_text(done["problem"]["detail"])
    expect(alert).to_contain_text("missing")  # the remedy names the option


def test_files_that_the_page_cannot_read_are_sent_all_the_same(
    visit: Visit, files: dict[str, bytes]
) -> None:
    buffer = io.BytesIO()
    np.savez(buffer, W=np.load(io.BytesIO(files["tracks.npy"])))
    page = visit.open()
    drop(page, {"tracks.npz": buffer.getvalue()})
    expect(page.locator(".files .note")).to_contain_text("no preview")
    expect(page.locator(".preview")).to_be_hidden()
    page.get_by_role("button", name="Send").click()
    page.wait_for_selector(".viewer[data-complete]")
    expect(page.locator(".stage-2d figcaption")).to_contain_text("projected")


def focused(page: Page) -> Locator:
    return page.locator(":focus")


def tab_to(page: Page, name: str) -> None:
    """Press Tab until an element of a name has the focus, which must be seen each time."""
    for _ in range(60):
        page.keyboard.press("Tab")
        here = focused(page)
        if not here.count():
            continue
        outline = here.evaluate("e => getComputedStyle(e).outlineStyle")
        hidden = here.evaluate("e => e.classList.contains('only-heard')")
        assert hidden or outline != "none", here.evaluate("e => e.outerHTML")
        text = here.evaluate(
            "e => e.getAttribute('aria-label') || e.labels?.[0]?.textContent || e.textContent"
        )
        if name in text:
            return
    raise AssertionError(f"{name} cannot be reached by Tab")


def test_all_works_by_keyboard(visit: Visit) -> None:
    visit.page.emulate_media(reduced_motion="reduce")
    page = visit.open()
    page.wait_for_selector(".options select")
    tab_to(page, "try a generated example")
    page.keyboard.press("Enter")
    expect(page.locator(".files li")).to_have_count(3)
    tab_to(page, "Send")
    page.keyboard.press("Enter")
    page.wait_for_selector(".viewer[data-complete]")
    tab_to(page, "The surface in 3D")
    front = picture(page)
    page.keyboard.press("d")
    page.wait_for_timeout(200)
    assert picture(page) != front
    page.keyboard.press("ArrowRight")
    assert frame_of(page) == "1"
    page.keyboard.press("Shift+ArrowRight")
    assert frame_of(page) == "11"
    page.keyboard.press("End")
    assert frame_of(page) == "59"
    page.keyboard.press("Space")
    expect(page.get_by_role("button", name="Pause")).to_be_visible()
    page.keyboard.press("Space")
    expect(page.get_by_role("button", name="Play")).to_be_visible()
    tab_to(page, "Play")
    page.keyboard.press("Space")
    expect(page.get_by_role("button", name="Pause")).to_be_visible()
    tab_to(page, "Delete")
    page.keyboard.press("Enter")
    expect(page.get_by_role("dialog")).to_contain_text("Delete")
    page.keyboard.press("Escape")
    expect(page.get_by_role("dialog")).to_have_count(0)


def test_the_list_follows_jobs_and_deletes_them(
    visit: Visit, site: Api, files: dict[str, bytes]
) -> None:
    page = visit.open("/#/jobs")
    page.wait_for_selector("table")
    with site.client() as client:
        sent = client.post("/v1/jobs", files={"measurements": ("mine.npy", files["tracks.npy"])})
        row = page.locator(f"tr[data-id='{sent.json()['id']}']")
        expect(row).to_be_visible()
        expect(row).to_contain_text("Done")
        expect(row).to_contain_text("30 × 400")
        row.get_by_role("button", name="Delete").click()
        page.get_by_role("dialog").get_by_role("button", name="Delete").click()
        expect(row).to_have_count(0)
        assert client.get(sent.headers["Location"]).status_code == 404


def test_a_job_is_cancelled_and_run_again(visit: Visit, site: Api, files: dict[str, bytes]) -> None:
    endless = {
        "camera_model": "relaxed",
        "shape_method": "nuclear",
        "shape_iterations": 100_000,
        "shape_tolerance": 1e-15,
    }
    sent = {"measurements": ("endless.npy", files["tracks.npy"])}
    with site.client() as client:
        job = client.post("/v1/jobs", files=sent, data={"options": json.dumps(endless)}).json()
    page = visit.open(f"/#/jobs/{job['id']}")
    expect(page.locator(".badge")).to_contain_text("Running")
    expect(page.locator(".percent")).to_contain_text("%")
    cancel = page.get_by_role("button", name="Cancel")
    cancel.evaluate("element => { element.dataset.kept = 'yes' }")
    detail = page.locator(".progress .help")
    expect(detail).not_to_have_text(detail.inner_text())
    expect(cancel, "progress does not replace buttons").to_have_attribute("data-kept", "yes")
    for again in (True, False):
        page.get_by_role("button", name="Cancel").click()
        expect(page.locator(".notice")).to_contain_text("was cancelled")
        if again:
            page.get_by_role("button", name="Run again").click()
            expect(page.locator(".facts")).to_contain_text("attempt 2")
    page.get_by_role("button", name="Delete").click()
    page.get_by_role("dialog").get_by_role("button", name="Delete").click()
    expect(page.get_by_role("heading", name="Jobs", exact=True)).to_be_visible()
    visit.refusals_expected = True
    visit.open(f"/#/jobs/{job['id']}")
    expect(page.get_by_role("heading", name="No such job")).to_be_visible()


def test_without_3d_the_rest_is_there(
    page_built: Path, site: Api, job: dict[str, Any], browser: Browser
) -> None:
    assert page_built.is_dir()
    with browser.browser_type.launch(
        executable_path=find_chromium(), args=[*FLAGS, "--disable-3d-apis"]
    ) as flat:
        page = flat.new_page()
        page.goto(f"{site.url}/#/jobs/{job['id']}")
        expect(page.locator(".viewer")).to_contain_text("draws no 3D")
        expect(page.locator(".downloads button")).to_have_count(5)


def test_a_key_is_asked_for_where_one_is_needed(
    browser: Browser,
    page_built: Path,
    files: dict[str, bytes],
    tmp_path_factory: pytest.TempPathFactory,
) -> None:
    assert page_built.is_dir()
    folder = tmp_path_factory.mktemp("keys")
    with contextlib.ExitStack() as stack:
        redis = stack.enter_context(redis_running(folder))  # no worker of another test takes jobs
        settings = settings_for(folder, redis, access="keys")
        _, secret = KeyStore(redis.client()).create("ada")
        stack.enter_context(WorkerPool(settings, 1))
        guarded = stack.enter_context(api_running(settings, redis, folder / "api.log"))
        visit = stack.enter_context(visiting(browser, guarded))
        visit.refusals_expected = True
        page = visit.open()
        page.get_by_label("wants an API key").fill("smsr_wrong")
        page.get_by_role("button", name="Use it").click()
        expect(page.locator(".key-form")).to_contain_text("does not take this key")
        page.locator("#key-input").fill(secret)
        page.get_by_role("button", name="Use it").click()
        expect(page.locator(".empty")).to_contain_text("No jobs yet")
        expect(page.locator(".key-form")).to_have_count(0)
        drop(page, {"tracks.npy": files["tracks.npy"]})
        page.get_by_role("button", name="Send").click()
        page.wait_for_selector(".viewer[data-complete]")
        with page.expect_download() as download:
            page.locator(".downloads button").first.click()
        assert download.value.path().stat().st_size > 1000
        with page.expect_download() as download:
            page.get_by_role("button", name="This job as JSON").click()
        assert json.loads(download.value.path().read_text())["status"] == "succeeded"
        page.get_by_text("Figures", exact=True).click()
        expect(page.locator(".figures canvas")).to_have_count(4)
        assert page.evaluate("localStorage.length") == 0


def test_a_phone_shows_everything_without_scrolling_sideways(
    browser: Browser, site: Api, job: dict[str, Any]
) -> None:
    phone = {"viewport": {"width": 375, "height": 740}, "device_scale_factor": 2}
    with visiting(browser, site, **phone, is_mobile=True, has_touch=True) as visit:
        for path in ("/", "/#/jobs"):
            page = visit.open(path)
            page.reload()
            page.wait_for_selector("main > *")
            assert page.evaluate("document.documentElement.scrollWidth") <= 375, path
        page = viewer_of(visit, job)
        assert page.evaluate("document.documentElement.scrollWidth") <= 375
        for selector in (".surface", ".stage-2d canvas"):
            box = page.locator(selector).bounding_box()
            assert box is not None
            assert box["width"] > 300
            assert box["height"] > 150
        page.get_by_role("button", name="Pause").tap()
        expect(page.get_by_role("button", name="Play")).to_be_visible()
        assert pixels(page) > 2000


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_no_serious_finding_of_axe(
    browser: Browser, site: Api, job: dict[str, Any], files: dict[str, bytes], scheme: str
) -> None:
    if not AXE.is_file():
        pytest.skip("axe-core is not installed (scripts/page installs it)")
    with visiting(browser, site, color_scheme=scheme, reduced_motion="reduce") as visit:
        found: dict[str, list[str]] = {}

        def look(where: str) -> None:
            visit.page.evaluate(AXE.read_text(encoding="utf-8"))
            result = visit.page.evaluate("() => axe.run({ resultTypes: ['violations'] })")
            for finding in result["violations"]:
                if finding["impact"] in ("serious", "critical"):
                    nodes = [node["html"] for node in finding["nodes"]]
                    found[f"{where}: {finding['id']}"] = nodes

        page = visit.open()
        drop(page, files)
        page.wait_for_selector(".options select")
        page.get_by_text("More options").click()
        look("new job")
        visit.open("/#/jobs")
        page.reload()
        page.wait_for_selector("tbody tr")
        look("jobs")
        with site.client() as client:
            sent = {"measurements": ("tracks.npy", files["tracks.npy"])}
            finished(client, client.post("/v1/jobs", files=sent, data={"batch": "axe"}))
        visit.open("/#/batches/axe")
        page.wait_for_selector(".batch progress")
        look("batch")
        viewer_of(visit, job)
        page.get_by_text("Keyboard", exact=True).click()
        page.get_by_text("Figures", exact=True).click()
        page.wait_for_selector(".figures canvas")
        look("viewer")
        assert found == {}
