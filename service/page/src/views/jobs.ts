/** The list of jobs, kept up to date while it is open. */

import { type Batch, isActive, type Job, listBatches, listJobs } from "../api";
import { append, h, replace } from "../dom";
import { followJobs } from "../events";
import { ago, count, exact, precise } from "../format";
import { errorPanel } from "../problem";
import { actions, apartFromProgress, badge, batchLink, title } from "./parts";

const PAGE = 50;

interface Choice {
  /** Only the newest, without a filter, beside the form of a new job. */
  short?: boolean;
  /** Only the jobs of a batch. */
  batch?: string;
  /** Called when jobs may have changed. */
  onchange?: () => void;
}

export function jobsView(
  signal: AbortSignal,
  { short = false, batch, onchange = () => {} }: Choice = {},
): HTMLElement {
  const jobs = new Map<string, Job>();
  let next: string | null = null;
  const rows = h("tbody", {});
  const problems = h("div", { class: "problems" });
  const empty = h("p", { class: "empty", hidden: true }, "No jobs yet.");
  const more = h("button", { type: "button", class: "more-jobs", hidden: true }, "Show more");
  const filter = h("select", { id: "status" });
  for (const [value, text] of [
    ["", "All"],
    ["queued", "Queued"],
    ["running", "Running"],
    ["succeeded", "Done"],
    ["failed", "Failed"],
    ["cancelled", "Cancelled"],
  ]) {
    append(filter, h("option", { value }, text));
  }

  const fits = (job: Job) =>
    (!filter.value || job.status === filter.value) && (!batch || job.batch === batch);
  const draw = () => {
    const shown = [...jobs.values()]
      .filter(fits)
      .sort((a, b) => b.created_at.localeCompare(a.created_at))
      .slice(0, short ? 8 : undefined);
    // A row is replaced only where it changed, so that the focus and open menus stay.
    const old = new Map([...rows.children].map((row) => [(row as HTMLElement).dataset.id, row]));
    const wanted = shown.map((job) => {
      const text = apartFromProgress(job);
      const known = old.get(job.id) as HTMLElement | undefined;
      if (known?.dataset.text === text) {
        known.querySelector(".badge")?.replaceWith(badge(job));
        return known;
      }
      const row = rowOf(job);
      row.dataset.text = text;
      return row;
    });
    if (wanted.length !== rows.children.length || wanted.some((r, i) => r !== rows.children[i])) {
      const held = (document.activeElement?.closest("tr") as HTMLElement | null)?.dataset.id;
      const label = document.activeElement?.getAttribute("aria-label");
      rows.replaceChildren(...wanted);
      if (held && document.activeElement === document.body) {
        const row = wanted.find((r) => r.dataset.id === held);
        const again = [...(row?.querySelectorAll<HTMLElement>("a, button") ?? [])];
        (again.find((e) => e.getAttribute("aria-label") === label) ?? again[0])?.focus();
      }
    }
    empty.hidden = shown.length > 0;
    empty.textContent = filter.value ? "No such jobs." : "No jobs yet.";
    more.hidden = short || next === null;
  };

  const fail = (error: unknown) => {
    if (!signal.aborted) replace(problems, errorPanel(error));
  };
  const rowOf = (job: Job): HTMLElement => {
    const extent = job.frames && job.points ? `${count(job.frames)} × ${count(job.points)}` : "–";
    const e3d = job.metrics ? precise(job.metrics.e3d) : "–";
    return h(
      "tr",
      { "data-id": job.id },
      h(
        "td",
        { class: "job-name" },
        h("a", { href: `#/jobs/${job.id}` }, title(job)),
        job.batch && !batch ? batchLink(job.batch) : null,
      ),
      h("td", { "data-label": "Status" }, badge(job)),
      h("td", { "data-label": "Frames × points", class: "number" }, extent),
      h("td", { "data-label": "e3D", class: "number" }, e3d),
      h(
        "td",
        { "data-label": "Sent" },
        h("time", { datetime: job.created_at, title: exact(job.created_at) }, ago(job.created_at)),
      ),
      h(
        "td",
        { class: "job-actions" },
        actions(
          job,
          {
            changed: (changed) => {
              jobs.set(changed.id, changed);
              draw();
            },
            gone: () => {
              jobs.delete(job.id);
              draw();
            },
            failed: fail,
          },
          false,
        ),
      ),
    );
  };

  const load = async (path: string, afresh: boolean) => {
    try {
      const page = await listJobs(path, signal);
      if (afresh) jobs.clear();
      for (const job of page.jobs) jobs.set(job.id, job);
      next = page.next;
      problems.replaceChildren();
      draw();
    } catch (error) {
      fail(error);
    }
  };
  const refresh = () => {
    onchange();
    const status = filter.value ? `&status=${filter.value}` : "";
    const only = batch ? `&batch=${batch}` : "";
    return load(`v1/jobs?limit=${short ? 8 : PAGE}${status}${only}`, true);
  };
  const batchList = h("p", { class: "batch-list", hidden: true });
  if (!short && !batch) {
    void listBatches(signal).then(({ batches }) => showBatches(batchList, batches), fail);
  }
  filter.addEventListener("change", () => void refresh());
  more.addEventListener("click", () => next && void load(next, false));
  void refresh();
  void followJobs(
    {
      refresh: () => void refresh(),
      job: (job) => {
        jobs.set(job.id, job);
        draw();
        onchange();
      },
      deleted: (id) => {
        jobs.delete(id);
        draw();
        onchange();
      },
    },
    signal,
  );
  const clock = setInterval(() => {
    if (![...jobs.values()].some(isActive)) draw();
  }, 60_000);
  signal.addEventListener("abort", () => clearInterval(clock));

  return h(
    "section",
    { class: `jobs card${short ? " short" : ""}`, "aria-labelledby": "jobs-title" },
    h(
      "div",
      { class: "row heading" },
      h(short || batch ? "h2" : "h1", { id: "jobs-title" }, short ? "Recent jobs" : "Jobs"),
      short
        ? h("a", { href: "#/jobs" }, "All jobs")
        : h("label", { class: "field", for: "status" }, h("span", {}, "Show"), filter),
    ),
    problems,
    batchList,
    h(
      "table",
      {},
      h(
        "thead",
        {},
        h(
          "tr",
          {},
          ["Name", "Status", "Frames × points", "e3D", "Sent"].map((text) =>
            h("th", { scope: "col" }, text),
          ),
          h("th", { scope: "col" }, h("span", { class: "only-heard" }, "Actions")),
        ),
      ),
      rows,
    ),
    empty,
    more,
  );
}

function showBatches(place: HTMLElement, batches: Batch[]): void {
  place.hidden = !batches.length;
  replace(
    place,
    "Batches: ",
    batches.map(({ label, total }) => h("span", {}, batchLink(label), ` ${count(total)}`)),
  );
}
