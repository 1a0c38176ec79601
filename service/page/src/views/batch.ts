/** One batch: how far its jobs are, what can be done with all of them, and their list. */

import {
  type Batch,
  getBatch,
  post,
  Refused,
  remove,
  save,
  type Spread,
  type Status,
} from "../api";
import { h, icon, replace } from "../dom";
import { count, precise, seconds } from "../format";
import { errorPanel } from "../problem";
import { jobsView } from "./jobs";
import { confirmed, facts, STATUS_NAMES } from "./parts";

/** Milliseconds in which many jobs may change and the batch is read once. */
const REST = 500;

export function batchView(label: string, signal: AbortSignal): HTMLElement {
  const title = () => h("h1", {}, `Batch ${label}`);
  const head = h("div", { class: "job-head" }, title());
  const problems = h("div", { class: "problems" });
  const summary = h("section", { class: "card batch", hidden: true, "aria-label": "Summary" });
  document.title = `Batch ${label} – SMSR`;
  const fail = (error: unknown) => {
    if (!signal.aborted) replace(problems, errorPanel(error));
  };

  const show = (batch: Batch) => {
    problems.replaceChildren();
    replace(head, title(), actions(batch, load, fail));
    replace(
      summary,
      h("progress", { max: 1, value: batch.progress ?? 0, "aria-label": "Progress of the batch" }),
      facts([
        ["Jobs", counts(batch)],
        ["e3D", batch.e3d ? spread(batch.e3d, precise) : null],
        ["Run time of a job", batch.timings?.run ? spread(batch.timings.run, seconds) : null],
        ["From first to last", batch.timings?.elapsed ? seconds(batch.timings.elapsed) : null],
      ]),
    );
    summary.hidden = false;
  };
  const load = async () => {
    try {
      show(await getBatch(label, signal));
    } catch (error) {
      summary.hidden = true;
      if (error instanceof Refused && error.problem.type === "/problems/unknown-batch") {
        replace(head, title());
        replace(problems, h("p", { class: "notice" }, "No job of this batch is left."));
      } else fail(error);
    }
  };

  let waiting = 0;
  const changed = () => {
    waiting ||= window.setTimeout(() => {
      waiting = 0;
      void load();
    }, REST);
  };
  signal.addEventListener("abort", () => clearTimeout(waiting));
  void load();
  return h(
    "article",
    { class: "job" },
    head,
    problems,
    summary,
    jobsView(signal, { batch: label, onchange: changed }),
  );
}

function counts({ total, jobs }: Batch): string {
  const parts = Object.entries(STATUS_NAMES)
    .filter(([status]) => jobs[status as Status])
    .map(([status, name]) => `${count(jobs[status as Status])} ${name.toLowerCase()}`);
  return `${count(total)}: ${parts.join(", ")}`;
}

const spread = ({ median, min, max }: Spread, format: (value: number) => string): string =>
  `${format(median)} (median), ${format(min)} to ${format(max)}`;

function actions(
  { label, links, jobs }: Batch,
  done: () => Promise<void>,
  failed: (error: unknown) => void,
): HTMLElement {
  const button = (name: string, glyph: string, act: () => Promise<unknown>) => {
    const element = h("button", { type: "button" }, icon(glyph), name);
    element.addEventListener("click", async () => {
      element.disabled = true;
      try {
        await act();
        await done();
      } catch (error) {
        failed(error);
      } finally {
        element.disabled = false;
      }
    });
    return element;
  };
  const lost = jobs.failed + jobs.cancelled;
  return h(
    "div",
    { class: "row", role: "group", "aria-label": "Actions" },
    links.results
      ? button("Results as ZIP", "down", () => save(links.results!, `${label}.zip`))
      : null,
    links.cancel ? button("Cancel all", "close", () => post(links.cancel!)) : null,
    links.retry && lost
      ? button(`Run ${count(lost)} again`, "retry", () => post(links.retry!))
      : null,
    button("Delete all", "bin", async () => {
      if (await confirmed(`Delete all jobs of ${label} and their files?`)) {
        await remove(links.self!);
      }
    }),
  );
}
